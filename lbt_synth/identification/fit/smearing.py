"""How the taper of a periodogram smears lines that are narrower than the record can show.

The expected periodogram of a line of half width g and distance d from its centre, both in units of
the inverse of the segment's duration, is the Lorentzian smeared by the taper h::

    K(g, d) = int e^(-2 pi g |t|) R(t) e^(-2 pi i d t) dt,   R the autocorrelation of h

It is tabulated once. (The same correction for any process is A. M. Sykulski et al., Biometrika
106, 251 (2019), doi:10.1093/biomet/asy071.)
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from lbt_synth.identification.fit.periodogram import tukey
from lbt_synth.validation import FloatArray

WIDE = 30.0  # half width above which a line is not smeared
_FAR = 400.0  # distance beyond which no line is smeared
_NOTHING = 0.003  # change of the logarithm of a line that is neglected
_NARROWEST = 1e-9
_WIDTHS = 72
_LOBES = 64.0  # distance up to which single lobes are resolved
_STEP = 0.1
_VALLEY = 0.003  # of the mean over a lobe, the least between lobes
_GROWTH = 1.03  # of the steps beyond, where lobes are averaged
_SAMPLES = 4096  # of the taper


@lru_cache(maxsize=1)
def _table() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return knots of log g (w,), a grid of distances (d,), and log K between both.

    The last has the coefficients of polynomials in two variables, cubic in the part of a step of
    the grid and in log g beyond its knot, the highest power of the latter first:
    (4, 4, w - 1, d - 1).
    """
    h = tukey(_SAMPLES)
    transform = np.fft.rfft(h, 2 * _SAMPLES)
    correlation = np.fft.irfft(np.abs(transform) ** 2)[:_SAMPLES]
    correlation /= correlation[0]
    t = np.arange(_SAMPLES) / _SAMPLES
    widths = np.geomspace(_NARROWEST, 1.2 * WIDE, _WIDTHS)
    places = np.arange(0, _LOBES + _STEP / 2, _STEP).tolist()
    while places[-1] < 1.05 * _FAR:
        places.append(places[-1] + _GROWTH * (places[-1] - places[-2]))
    grid = np.array(places)
    decaying = 2 / _SAMPLES * correlation * np.exp(-2 * np.pi * np.outer(widths, t))
    decaying[:, 0] /= 2
    waves = np.cos(2 * np.pi * np.outer(t, grid))
    at, mean = decaying @ waves, (decaying * np.sinc(t)) @ waves  # the mean over a lobe
    # of the taper itself, not of its samples
    at, mean = (each * np.sinc(grid / _SAMPLES) ** 2 for each in (at, mean))
    at = np.maximum(at, _VALLEY * mean)  # no fit crosses the zeros between lobes
    blend = np.clip((grid - _LOBES / 2) / (_LOBES / 2), 0, 1)
    k = np.maximum(at * (1 - blend) + mean * blend, 1e-14)
    knots = np.log(widths)
    value = CubicSpline(knots, np.log(k)).c  # (4, w, d)
    slope = np.asarray(np.gradient(value, axis=2))
    rise, (m0, m1) = np.diff(value, axis=2), (slope[..., :-1], slope[..., 1:])
    powers = [value[..., :-1], m0, 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise]
    return knots, grid, np.stack(powers, axis=1)


@lru_cache(maxsize=1)
def _reaches() -> FloatArray:
    """Return beyond which distance a line of each tabulated width is hardly changed, (w,)."""
    knots, grid, table = _table()
    g, distance = np.exp(knots)[:-1, None], grid[:-1]
    change = table[-1, 0] + np.log(np.pi / g * (g**2 + distance**2))
    last = np.max(np.where(np.abs(change) > _NOTHING, grid[1:], 0.0), axis=1)
    return np.maximum.accumulate(last[::-1])[::-1]


def smearing_reach(half_width: FloatArray) -> FloatArray:
    """Return the distance beyond which lines are hardly changed, (n,)."""
    knots, *_ = _table()
    row = np.searchsorted(knots, np.log(np.maximum(half_width, _NARROWEST)), side="right") - 1
    return _reaches()[np.minimum(row, knots.size - 2)]


def log_smearing(
    half_width: FloatArray | float, distance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the logarithm of the ratio of smeared lines to the lines themselves, (f,).

    The half width is one for all, or (f,) as the distance. The derivatives by the logarithm of the
    width and by the distance follow.
    """
    knots, grid, table = _table()
    g, size = np.broadcast_to(half_width, distance.shape), np.abs(distance)
    log_width = np.log(np.maximum(g, _NARROWEST))
    row = np.minimum(np.searchsorted(knots, log_width, side="right") - 1, knots.size - 2)
    w = log_width - knots[row]
    left = np.minimum(np.searchsorted(grid, size, side="right") - 1, grid.size - 2)
    step = grid[left + 1] - grid[left]
    x = (size - grid[left]) / step
    c3, c2, c1, c0 = table.reshape(4, 4, -1).take(row * (grid.size - 1) + left, axis=2)
    y0, y1, y2, y3 = ((c3 * w + c2) * w + c1) * w + c0
    v0, v1, v2, v3 = ((3 * c3 * w + 2 * c2) * w + c1) * (g > _NARROWEST)
    square = g**2 + distance**2
    return (
        y0 + x * (y1 + x * (y2 + x * y3)) + np.log(np.pi / g * square),
        v0 + x * (v1 + x * (v2 + x * v3)) + (2 * g**2 / square - 1),
        (y1 + x * (2 * y2 + 3 * x * y3)) / step * np.sign(distance) + 2 * distance / square,
    )
