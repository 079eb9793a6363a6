"""Gain files: FITS (loaded as it is by SPECULA's state-space filter) and NPZ."""
