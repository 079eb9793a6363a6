"""Identification of a recorded loop, and designs tested on its data.

Records come from files of any origin, with a report on their faults.
The fit returns turbulence, vibration lines, noise and sensor gain with standard errors.
Predictions are tested on data that nothing was fitted to.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
