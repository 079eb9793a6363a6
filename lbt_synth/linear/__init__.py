"""Linear systems, estimation problems and the equations that solve them.

This room knows no telescope: a control engineer can use it alone.
It holds discrete-time state-space systems, Riccati equations, linear matrix inequalities,
H-infinity norms and Lyapunov equations.
Every solution carries its residual, and every refusal says which condition failed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
