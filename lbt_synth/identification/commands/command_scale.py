"""The factor between commands and measurements that an implausible sensor gain shows."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import FloatArray

_FACTORS = (*(10.0**n for n in range(-12, 13) if n), 0.5, 2.0)  # between units, or of reflection
_USUAL_GAIN = 0.7
_COARSE = 1.5  # factor by which a coarse gain may be wrong
_APART = 1.6  # between gains of two axes that have scales of their own


def usual_gain(plausible: tuple[float, float]) -> float:
    """Return the gain that a sensor has most often."""
    return float(np.clip(_USUAL_GAIN, *plausible))


def likely_factors(gains: FloatArray, plausible: tuple[float, float]) -> FloatArray:
    """Return the likeliest factor of the commands of each axis with these gains, (axes,)."""
    low, high = plausible
    if np.max(gains) < _APART * np.min(gains):
        together = float(np.exp(np.mean(np.log(gains))))
        return np.full(gains.size, _likely_factor(together, plausible))
    each = [1.0 if low <= gain <= high else _likely_factor(gain, plausible) for gain in gains]
    return np.array(each)


def _likely_factor(gain: float, plausible: tuple[float, float]) -> float:
    """Return the likeliest factor of commands with a gain."""
    low, high = plausible
    usual = usual_gain(plausible)
    fits = [f for f in _FACTORS if low <= gain / f <= high]
    fits = fits or [f for f in _FACTORS if low / _COARSE <= gain / f <= _COARSE * high]
    if fits:
        return float(min(fits, key=lambda f: abs(np.log(gain / f / usual))))
    return float(f"{gain / usual:.2g}")
