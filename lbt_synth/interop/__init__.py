"""Controllers in other people's programs.

One folder per program: ``c`` writes C99 source, ``dao`` the matrix of a real-time computer,
``matlab`` a MATLAB file, ``pyrtc`` a configuration and the predictor that it names. Before a file
is written, what it holds is run beside the controller.
``specula`` runs a design end to end, on optics simulated by SPECULA.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
