"""Reduce a million samples to some hundred points for the charts of a study."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.variance_index import is_list
from lbt_synth.validation import FloatArray, IntArray, frozen_copy

_POINTS = 200  # of a cumulative distribution
_BINS = 30  # of a histogram, at most
_CELLS = 32  # along either axis of a map, at most
_WITHIN = 1, 99  # percentiles at the edges of a map; its outermost cells hold what is beyond
_PER_CELL = 8  # samples in a cell of a map on average, at least


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BinnedMap:
    """Mean of a result over a grid of two parameters."""

    x: FloatArray  # centres of the cells, or the values of a list, (nx,)
    y: FloatArray  # (ny,)
    mean: FloatArray  # (ny, nx); nan in a cell without samples
    samples: FloatArray  # number in each cell, (ny, nx)


def cumulative_points(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return levels (k,) and the part of the values at or below each, denser in the tails.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies.study.binning import cumulative_points
    >>> level, part = cumulative_points(np.array([0.0, 0.0, 0.5, 1.0]))
    >>> level, part
    (array([0. , 0.5, 1. ]), array([0.5 , 0.75, 1.  ]))
    """
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
    """Return the mean of a result (n,) over a grid of two varying parameters (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies.study.binning import binned_map
    >>> gain, wind = np.meshgrid(np.linspace(0, 1, 40), [10.0, 20.0])
    >>> found = binned_map(gain.ravel(), wind.ravel(), wind.ravel() / 100)
    >>> found.y, found.mean[:, 0]
    (array([10., 20.]), array([0.1, 0.2]))
    """
    cells = len(x) / _PER_CELL
    lists = [value_shares(x), value_shares(y)]
    for found in lists:
        cells /= len(found[0]) if found is not None else 1
    free = sum(found is None for found in lists)
    width = int(np.clip(cells ** (1 / free), 3, _CELLS)) if free else 0
    columns, x_places = _assign_cells(x, lists[0], width)
    rows, y_places = _assign_cells(y, lists[1], width)
    cell = y_places * len(columns) + x_places
    size = len(rows) * len(columns)
    samples = np.bincount(cell, minlength=size).astype(np.float64)
    sums = np.bincount(cell, weights=result, minlength=size)
    mean = np.full(size, np.nan)
    np.divide(sums, samples, out=mean, where=samples > 0)
    shape = len(rows), len(columns)
    return BinnedMap(
        x=frozen_copy(columns),
        y=frozen_copy(rows),
        mean=frozen_copy(mean.reshape(shape)),
        samples=frozen_copy(samples.reshape(shape)),
    )


def _assign_cells(
    values: FloatArray, listed: tuple[FloatArray, FloatArray] | None, cells: int
) -> tuple[FloatArray, IntArray]:
    """Return the centres of the cells along one axis, and the cell of each sample."""
    if listed is not None:
        return listed[0], np.searchsorted(listed[0], values)
    low, high = np.percentile(values, _WITHIN)
    if not low < high:
        low, high = float(np.min(values)), float(np.max(values))
    edges = np.linspace(low, high, cells + 1)
    places = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, cells - 1)
    return (edges[:-1] + edges[1:]) / 2, places
