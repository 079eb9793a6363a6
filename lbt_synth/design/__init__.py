"""Controllers by convex synthesis, each with a certificate.

Each method takes a plant or an estimation problem and returns a design.
The certificate is computed after the synthesis and does not trust the solver.
A design that fails its certificate is never returned: the method raises.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
