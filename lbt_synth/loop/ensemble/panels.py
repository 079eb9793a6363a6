"""Panels of quadrature that are refined around the poles of many loops."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import ComplexArray, FloatArray

_NARROWEST = 1e-10  # pole width that panels are still refined to, as a fraction of Nyquist
_PANEL = 2.0  # length of a panel over its distance from a pole, or over the pole's width


def graded_edges(poles: ComplexArray) -> FloatArray:
    """Panels of (0, 1), as fractions of Nyquist, that are short where a pole is near.

    A panel is halved while it is longer than twice its distance from a pole, or than twice
    the width of a pole that it holds.
    """
    upper = poles[poles.imag >= 0]
    centre = np.abs(np.angle(upper)) / np.pi
    width = np.maximum(1 - np.abs(upper), np.pi * _NARROWEST) / np.pi
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1, 24)])
    low, high = grid[:-1], grid[1:]
    done = [np.ones(1)]
    while low.size:
        outside = np.maximum(low[:, None] - centre, centre - high[:, None])
        nearest = np.min(np.maximum(outside, width), axis=1, initial=1.0)
        long = high - low > _PANEL * nearest
        done.append(low[~long])
        middle = (low[long] + high[long]) / 2
        low, high = np.concatenate([low[long], middle]), np.concatenate([middle, high[long]])
    return np.sort(np.concatenate(done))
