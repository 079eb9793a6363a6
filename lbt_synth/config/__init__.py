"""Configuration files in YAML, with units in their keys.

The schema refuses unknown keys and says where the mistake is.
A loaded configuration builds the plant, the truth, the hardware and the imaging camera.
An identified model is written as a configuration that loads again.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
