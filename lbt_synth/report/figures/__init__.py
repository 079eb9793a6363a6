"""Figures of designs, loops and studies, drawn by matplotlib.

Each function returns a matplotlib figure.
Each draws on a new figure, or on your own axes. Pages show the same figures.
Curves differ in colour, dash and marker, so that a reader can distinguish them in grey.
Axes carry units.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
