"""Specifications of a closed loop that are convex in the Youla parameter.

A specification has one objective and any number of demands.
Each term is a finite conic programme on a grid of frequencies.
Each is evaluated again, exactly and between the grid points, before a design is returned.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
