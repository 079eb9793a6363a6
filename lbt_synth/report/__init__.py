"""Figures and pages that people read.

Figures are drawn by matplotlib for papers.
Pages are single HTML files with interactive charts, and PDF on request.
Every number on a page comes from a study or a design, never from the page.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
