"""Bounds at single frequencies, tightened for what lies between them."""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.convex_functions import Discs
from lbt_synth.validation import ComplexArray, FloatArray

ROOM = 1e-3  # part of a bound that the programme leaves for what lies between its points
LEVEL_SETS = "level sets, all frequencies"


def discs(
    frequency_hz: FloatArray, rows: ComplexArray, centres: FloatArray, radii: FloatArray | float
) -> Discs:
    """Return discs ``|centres + rows c| <= radii`` at frequencies."""
    return Discs(
        frequency_hz=frequency_hz,
        rows=rows,
        centres=centres.astype(np.complex128),
        radii=np.broadcast_to(np.asarray(radii, dtype=np.float64), centres.shape),
    )
