"""What a telescope's tip/tilt loop is made of.

Turbulence, vibrations, the wavefront sensor and the mirror are models with units.
A plant is what a design believes; a truth is what the telescope really does.
The two may differ, and most studies ask what happens when they do.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
