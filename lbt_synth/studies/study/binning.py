"""Groups and bins that reduce a million samples of a study to some hundred points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.validation import FloatArray, IntArray, frozen_copy

_POINTS = 200  # of a cumulative distribution
_BINS = 30  # of a histogram, at most
_CELLS = 32  # along either axis of a map, at most
_WITHIN = 1, 99  # percentiles at the edges of a map; its outermost cells hold what is beyond
_MOST_VALUES = 32  # a parameter with more distinct values is continuous
_PER_CELL = 8  # samples in a cell of a map on average, at least


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BinnedMap:
    """Mean of a result over a grid of two parameters."""

    x: FloatArray  # centres of the cells, or the values of a list, (nx,)
    y: FloatArray  # (ny,)
    mean: FloatArray  # (ny, nx); nan in a cell without samples
    samples: FloatArray  # number in each cell, (ny, nx)


def is_list(ordered: FloatArray) -> bool:
    """Whether a parameter, given in rising order, takes few values, as from a list of a study."""
    distinct = 1 + int(np.count_nonzero(np.diff(ordered)))
    return distinct <= min(_MOST_VALUES, max(2, len(ordered) // 5))


def value_starts(ordered: FloatArray) -> IntArray:
    """Return the first index of each value of a list, given in rising order."""
    return np.concatenate(([0], 1 + np.flatnonzero(np.diff(ordered)))).astype(np.int64)


def group_starts(ordered: FloatArray, groups: int) -> IntArray:
    """Return the first index of each of some groups of about equal size, in rising order.

    Equal values are in one group, so that the order of their samples is of no matter.
    """
    n = len(ordered)
    return np.unique(np.searchsorted(ordered, ordered[np.arange(groups) * n // groups]))


def cumulative_points(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return levels (k,) and the part of the values at or below each, denser in the tails."""
    ordered = np.sort(values)
    n = len(ordered)
    if n <= 2 * _POINTS:
        ranks = np.arange(n)
    else:
        tail = np.unique(np.geomspace(1, n / 4, _POINTS // 4).astype(np.int64)) - 1
        ranks = np.unique(
            np.concatenate((tail, n - 1 - tail, np.linspace(0, n - 1, _POINTS).astype(np.int64)))
        )
    level = np.unique(ordered[ranks])
    return level, np.searchsorted(ordered, level, side="right") / n


def histogram(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return edges of bins (k + 1,) and the part of the values in each (k,)."""
    bins = int(np.clip(np.sqrt(len(values)), 4, _BINS))
    counts, edges = np.histogram(values, bins=bins)
    return edges, counts / len(values)


def value_shares(values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the distinct values of a list parameter and their parts; None if it is no list."""
    if not is_list(np.sort(values)):
        return None
    found, counts = np.unique(values, return_counts=True)
    return found, counts / len(values)


def binned_map(x: FloatArray, y: FloatArray, result: FloatArray) -> BinnedMap:
    """Return the mean of a result (n,) over a grid of two varying parameters (n,)."""
    cells = len(x) / _PER_CELL
    lists = [value_shares(x), value_shares(y)]
    for found in lists:
        cells /= 1 if found is None else len(found[0])
    width = int(np.clip(cells ** (1 / max(lists.count(None), 1)), 3, _CELLS))
    columns, x_edges = _cells(x, lists[0], width)
    rows, y_edges = _cells(y, lists[1], width)
    samples = np.histogram2d(y, x, bins=(y_edges, x_edges))[0]
    sums = np.histogram2d(y, x, bins=(y_edges, x_edges), weights=result)[0]
    mean = np.full(samples.shape, np.nan)
    np.divide(sums, samples, out=mean, where=samples > 0)
    return BinnedMap(
        x=frozen_copy(columns),
        y=frozen_copy(rows),
        mean=frozen_copy(mean),
        samples=frozen_copy(samples),
    )


def _cells(
    values: FloatArray, listed: tuple[FloatArray, FloatArray] | None, cells: int
) -> tuple[FloatArray, FloatArray]:
    """Return the centres of the cells along one axis, and their edges."""
    if listed is not None:
        centres = listed[0]
        inner = (centres[:-1] + centres[1:]) / 2
    else:
        low, high = np.percentile(values, _WITHIN)
        if not low < high:
            low, high = float(np.min(values)), float(np.max(values))
        edges = np.linspace(low, high, cells + 1)
        centres, inner = (edges[:-1] + edges[1:]) / 2, edges[1:-1]
    return centres, np.concatenate(([-np.inf], inner, [np.inf]))
