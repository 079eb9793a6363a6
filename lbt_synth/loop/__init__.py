"""The loop around a controller: what it leaves, bears and does in time, exactly and simulated."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
