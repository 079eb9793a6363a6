"""Control of hundreds of modes.

The reconstructor takes slopes to modes.
Every mode gets an integrator gain or a Kalman filter, designed and certified in one call.
Their loop is closed exactly, and in long simulations.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
