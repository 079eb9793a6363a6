"""The taper of a segment, and how it smears a narrow line.

A resonance that decays slower than the record lasts is narrower than the record can show. The
expected periodogram of a line of half width g and distance d from its centre, both in units of
the inverse of the segment's duration, is the Lorentzian smeared by the taper h::

    K(g, d) = int e^(-2 pi g |t|) R(t) e^(-2 pi i d t) dt,   R the autocorrelation of h

It is tabulated once. (The same correction for any process is A. M. Sykulski et al., Biometrika
106, 251 (2019), doi:10.1093/biomet/asy071.)
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from lbt_synth.validation import FloatArray, IntArray

TAPER = 0.1  # of a segment, both ends together
WIDE = 30.0  # half width above which a line is not smeared
FAR = 400.0  # distance beyond which a line is not smeared
_NARROWEST = 1e-9
_WIDTHS = 72
_LOBES = 64.0  # distance up to which single lobes are resolved
_STEP = 0.1
_GROWTH = 1.03  # of the steps beyond, where lobes are averaged
_SAMPLES = 4096  # of the taper
_PADDED = 1 << 17


def tukey(length: int) -> FloatArray:
    """Return the taper of a segment, a cosine at either end."""
    from scipy.signal.windows import tukey as window

    return np.asarray(window(length, TAPER))


@lru_cache(maxsize=1)
def _table() -> tuple[Any, FloatArray]:
    """Return a spline over log g of log K on a grid of distances, and the grid."""
    from scipy.interpolate import CubicSpline

    h = tukey(_SAMPLES)
    transform = np.fft.rfft(h, 2 * _SAMPLES)
    correlation = np.fft.irfft(np.abs(transform) ** 2)[:_SAMPLES]
    correlation /= correlation[0]
    t = np.arange(_SAMPLES) / _SAMPLES
    widths = np.geomspace(_NARROWEST, 1.2 * WIDE, _WIDTHS)
    near = np.arange(0, _LOBES, _STEP)
    far = [near[-1] + _STEP]
    while far[-1] < 1.05 * FAR:
        far.append(far[-1] + (far[-1] - (far[-2] if len(far) > 1 else near[-1])) * _GROWTH)
    grid = np.concatenate([near, far])
    fine = np.arange(_PADDED // 2 + 1) * (_SAMPLES / _PADDED)
    spread = int(_PADDED / _SAMPLES)  # points of a unit of distance
    kernel = np.ones(spread) / spread
    blend = np.clip((grid - _LOBES / 2) / (_LOBES / 2), 0, 1)
    rows = []
    for g in widths:
        decaying = correlation * np.exp(-2 * np.pi * g * t)
        decaying[0] /= 2
        k = 2 * np.fft.rfft(decaying, _PADDED).real / _SAMPLES
        k = np.maximum(k, 1e-14)
        mean = np.convolve(k, kernel, mode="same")
        at = np.exp(np.interp(grid, fine, np.log(k)))
        rows.append(np.log(at * (1 - blend) + np.interp(grid, fine, mean) * blend))
    return CubicSpline(np.log(widths), np.array(rows)), grid


def log_smearing(
    half_width: float, distance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the logarithm of the smeared line over the line itself, (f,).

    Its derivatives by the logarithm of the width and by the distance follow.
    """
    spline, grid = _table()
    log_width = np.log(max(half_width, _NARROWEST))
    size = np.abs(distance)
    left = np.minimum(np.searchsorted(grid, size, side="right") - 1, grid.size - 2)
    step = grid[left + 1] - grid[left]
    part = (size - grid[left]) / step
    value, by_place = _between(spline(log_width), left, part)
    by_size = by_place / step
    by_width = np.zeros_like(value)
    if half_width > _NARROWEST:
        by_width, _ = _between(spline(log_width, 1), left, part)
    g = half_width
    both = g**2 + distance**2
    return (
        value + np.log(np.pi * both / g),
        by_width + (2 * g**2 / both - 1),
        by_size * np.sign(distance) + 2 * distance / both,
    )


def _between(row: FloatArray, left: IntArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a cubic between the values of a row, and its derivative, at ``left + x``."""
    slope = np.gradient(row)
    y0, m0, m1 = row[left], slope[left], slope[left + 1]
    rise = row[left + 1] - y0
    second, third = 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise
    return y0 + x * (m0 + x * (second + x * third)), m0 + x * (2 * second + 3 * x * third)
