"""Faults that a channel of an accelerometer shows by itself."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.records.faults import find_saturated
from lbt_synth.validation import FloatArray

_FEWEST_VALUES = 4  # a series of no more different numbers is rounding
_ROUNDING = 1e-12  # of the largest number
_LEAST_M_S2 = 1e-6  # far below what any accelerometer resolves
_CLIPPED = 10  # frames at the ends, at least
_DRIFT = 100.0  # power at low frequencies over the median
_SLOW_HZ = 1.0


def channel_fault(readings: FloatArray, rate_hz: float) -> str:
    """Return dead, saturated, drifting, or an empty text, for the readings (frames,) of one."""
    readings = readings[np.isfinite(readings)]
    values = np.unique(readings)
    rounding = _ROUNDING * max(float(np.max(np.abs(values), initial=0.0)), _LEAST_M_S2)
    if values.size <= _FEWEST_VALUES or np.ptp(values) <= rounding:
        return "dead"
    if np.sum(find_saturated(readings, np.ones(readings.size, dtype=np.bool_))) >= _CLIPPED:
        return "saturated"
    return "drifting" if _drifts(readings, rate_hz) else ""


def _drifts(readings: FloatArray, rate_hz: float) -> bool:
    from scipy.signal import periodogram

    frequency, power = periodogram(readings, rate_hz, window="cosine")
    slow = (frequency > 0) & (frequency < _SLOW_HZ)
    if not slow.any():
        return False
    return bool(np.mean(power[slow]) > _DRIFT * np.median(power[1:]))
