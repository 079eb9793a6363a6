"""Controllers in other people's programs.

A controller becomes C99 source, a MATLAB file or a SPECULA filter.
Each export is rehearsed beside the controller before it is written.
The end-to-end simulation runs a design on optics simulated by SPECULA.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
