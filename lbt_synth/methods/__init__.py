"""The methods of synthesis, one module each; nothing else knows their names.

A module of this folder with a ``METHOD`` is a method.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
