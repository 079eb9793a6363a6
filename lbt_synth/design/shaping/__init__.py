"""Objectives and demands of a loop that is shaped by convex programmes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
