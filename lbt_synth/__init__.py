"""Certified convex synthesis of tip/tilt controllers for adaptive optics.

The public names are listed in ``__init__.pyi`` and are imported when first
used, so that ``import lbt_synth`` costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.2.0"
