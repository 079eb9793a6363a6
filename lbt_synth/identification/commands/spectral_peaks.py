"""Peaks of a periodogram over their surroundings, without the import of ``scipy.signal``."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lbt_synth.validation import BoolArray, FloatArray, IntArray

_PEAK, _SKIRT = 3.0, 1.25  # over the surroundings
_SURROUNDINGS, _REACH, _MOST_PEAKS = 81, 40, 16  # frequencies, frequencies, peaks
_APART = 4  # frequencies between peaks


def find_spectral_peaks(
    frequency_hz: FloatArray, power: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the frequencies at peaks (f,), where the peaks are (l,), and their widths (l,)."""
    log = np.log(smooth_neighbours(power))
    above = log - surrounding_median(log, _SURROUNDINGS)
    tops = find_tops(above, least=float(np.log(_PEAK)), apart=_APART)[:_MOST_PEAKS]
    is_peak = np.zeros(power.size, dtype=np.bool_)
    for top in tops:
        low, high = max(top - _REACH, 0), min(top + _REACH + 1, power.size)
        ends = np.flatnonzero(above[low:high] <= np.log(_SKIRT)) + low
        start = np.max(ends[ends < top], initial=low)
        stop = np.min(ends[ends > top], initial=high - 1)
        is_peak[max(start - 1, 0) : stop + 2] = True
    edges = np.flatnonzero(np.diff(np.r_[False, is_peak, False].astype(int))).reshape(-1, 2)
    lines = np.array([frequency_hz[a + np.argmax(power[a:b])] for a, b in edges])
    step = frequency_hz[1] - frequency_hz[0]
    width = np.array([max(2.0, 0.3 * (b - a)) * step for a, b in edges])
    return is_peak, lines, width / lines


def smooth_neighbours(values: FloatArray) -> FloatArray:
    """Return the means of each value and its two neighbours, (f,); the ends are repeated."""
    return np.asarray(sliding_window_view(np.pad(values, 1, mode="edge"), 3).mean(axis=-1))


def surrounding_median(values: FloatArray, size: int) -> FloatArray:
    """Return the median of an odd number of values around each, (f,); the ends are repeated."""
    windows = sliding_window_view(np.pad(values, size // 2, mode="edge"), size)
    return np.asarray(np.partition(windows, size // 2, axis=-1)[:, size // 2])


def find_tops(values: FloatArray, *, least: float, apart: int) -> IntArray:
    """Return where local maxima are, at least so high and some values apart, the highest first."""
    inner = values[1:-1]
    tops = 1 + np.flatnonzero((inner > values[:-2]) & (inner >= values[2:]) & (inner >= least))
    out: list[int] = []
    for top in tops[np.argsort(-values[tops], kind="stable")].tolist():
        if all(abs(top - other) >= apart for other in out):
            out.append(top)
    return np.array(out, dtype=np.int64)
