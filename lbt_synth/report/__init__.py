"""Figures and pages that people read.

Matplotlib draws every figure, for files, for your own axes and for pages.
Pages are single HTML files without scripts, and PDF on request.
Every number on a page comes from a study or a design, never from the page.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
