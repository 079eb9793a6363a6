"""Maps of coloured cells: their edges, colours and levels, and which cells lie together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from lbt_synth.validation import BoolArray, FloatArray

STREHL_LEVELS = (10, 20, 30, 40, 50, 60, 70, 75, 80, 83, 86, 90, 95, 98)  # [%]


def cell_edges(centres: FloatArray) -> FloatArray:
    """Return the ends of the cells of increasing values, halfway between them."""
    if centres.size == 1:
        return np.array([centres[0] - 0.05, centres[0] + 0.05])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def marked_intervals(marked: BoolArray, edges: FloatArray) -> list[tuple[float, float]]:
    """Intervals that consecutive marked cells cover."""
    steps = np.diff(np.concatenate([[False], marked, [False]]).astype(np.int64))
    starts, ends = np.nonzero(steps > 0)[0], np.nonzero(steps < 0)[0]
    return [(float(edges[i]), float(edges[j])) for i, j in zip(starts, ends, strict=True)]


def blank_cells(
    blank: BoolArray, x: FloatArray, y: FloatArray
) -> Iterator[tuple[float, float, float, float]]:
    """Left, right, low and high end of rectangles that cover the cells without a value."""
    whole = np.all(blank, axis=1)
    for low, high in marked_intervals(whole, y):
        yield float(x[0]), float(x[-1]), low, high
    for row, (low, high) in enumerate(pairwise(y)):
        if not whole[row]:
            for left, right in marked_intervals(blank[row], x):
                yield left, right, float(low), float(high)


def strehl_scale(strehls: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the ends [%] of one colour scale for several maps of Strehl ratios."""
    values = 100 * np.concatenate([strehl.ravel() for strehl in strehls])
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 100.0
    low, high = float(values.min()), float(values.max())
    return (low, high) if high - low > 1 else (low - 0.5, high + 0.5)


def levels_within(values: FloatArray, levels: Sequence[float]) -> list[float]:
    """Levels between the least and the largest value of a map."""
    inside = values[np.isfinite(values)]
    if min(values.shape) < 2 or not inside.size:
        return []
    return [level for level in levels if inside.min() < level < inside.max()]


def level_colour(level: float, low: float, high: float) -> str:
    """Colour in which a line of equal value is seen on a colour scale with these ends."""
    return "white" if level < (low + high) / 2 else "black"
