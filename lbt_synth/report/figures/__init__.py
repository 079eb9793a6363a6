"""Figures of designs, loops and studies, drawn by matplotlib.

Each function returns a matplotlib figure.
Curves differ in colour, dash and marker, so that a reader can distinguish them in grey.
Axes carry units.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
