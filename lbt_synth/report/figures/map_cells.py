"""Cells of a map: their edges, and which of them lie together."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import BoolArray, FloatArray


def cell_edges(centres: FloatArray) -> FloatArray:
    """Return the ends of the cells of increasing values, halfway between them."""
    if centres.size == 1:
        return np.array([centres[0] - 0.05, centres[0] + 0.05])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def bands(marked: BoolArray, edges: FloatArray) -> list[tuple[float, float]]:
    """Intervals that consecutive marked cells cover."""
    steps = np.diff(np.concatenate([[False], marked, [False]]).astype(np.int64))
    starts, ends = np.nonzero(steps > 0)[0], np.nonzero(steps < 0)[0]
    return [(float(edges[i]), float(edges[j])) for i, j in zip(starts, ends, strict=True)]
