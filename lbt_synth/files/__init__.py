"""Gain files and telemetry files.

Gain files are FITS or NPZ, and SPECULA loads the FITS ones as they are.
Telemetry is read and written in our own layout and in the AOT standard.
What is loaded has been checked, and what is written is written whole.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
