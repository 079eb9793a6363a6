"""The factor between commands and measurements that an implausible sensor gain shows."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import FloatArray

PLAUSIBLE_GAINS = (0.2, 1.25)  # of a sensor whose commands are in the unit of its measurements
_FACTORS = (*(10.0**n for n in range(-12, 13) if n), 0.5, 2.0)  # between units, or of reflection
_USUAL_GAIN = 0.7
_COARSE = 1.5  # factor by which a coarse gain may be wrong


def likely_factor(gains: FloatArray, plausible: tuple[float, float]) -> tuple[float, float]:
    """Return the likeliest factor of commands with these gains, and a usual gain."""
    low, high = plausible
    gain = float(np.exp(np.mean(np.log(gains))))
    usual = float(np.clip(_USUAL_GAIN, low, high))
    fits = [f for f in _FACTORS if low <= gain / f <= high]
    fits = fits or [f for f in _FACTORS if low / _COARSE <= gain / f <= _COARSE * high]
    if fits:
        return float(min(fits, key=lambda f: abs(np.log(gain / f / usual)))), usual
    return float(f"{gain / usual:.2g}"), usual
