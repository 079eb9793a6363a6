"""Gain files: FITS (loaded as it is by SPECULA's state-space filter), NPZ and JSON."""
