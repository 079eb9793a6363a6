"""The closed loop: stability, margins, exact residual and Strehl ratio.

A controller, designed here or elsewhere, is closed around the sensor, the delay and the mirror.
Residuals are exact integrals over spectra, not averages over a simulation.
They can be compared with the least residual that any linear controller leaves.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
