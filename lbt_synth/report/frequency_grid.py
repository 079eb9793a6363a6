"""The frequencies at which transfer functions are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lbt_synth.validation import FloatArray

_POINTS = 1200


def frequency_grid(
    rate_hz: float, special_hz: Sequence[float] = (), *, decades: float = 3.6
) -> FloatArray:
    """Logarithmic grid up to Nyquist, denser around special frequencies."""
    nyquist = rate_hz / 2
    grids = [np.geomspace(nyquist / 10**decades, nyquist, _POINTS)]
    for centre in special_hz:
        spread = np.geomspace(1e-4, 0.2, 60)
        grids += [centre * (1 + spread), centre * (1 - spread), np.array([centre])]
    grid = np.unique(np.concatenate(grids))
    return grid[(grid > 0) & (grid <= nyquist)]
