"""Faults of series: stuck, saturated and outlying values.

Each finder takes a series (frames,) and the frames that count so far, and returns the
frames that are at fault. Nothing is known of the sensor, so thresholds come from the series:
a clean record, with or without strong narrow lines, quantised or not, shows none.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.special import ndtri

from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.storage.rows import column, percent_column, table_row
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_SHORTEST_RUN = 5  # equal values, a stuck sensor
SURPRISING = 4.0  # standard errors that chance does not explain: 0.006 %
RARE = 1e-3  # chance of what a good record may show, and is noted
_MANY_RUNS = 100  # needed to compute a chance
_LIMIT_RATIO = 4  # of values at an end of the range over those at each of as many next levels
_OUTLIER = 6.5  # standard deviations of the second difference: 1e-4 clean frames in a million
MAD = 1 / float(ndtri(0.75))  # standard deviation of a normal law over its median deviation
_BLOCK = SHORTEST_SEGMENT  # frames of a local scale


def runs(flags: BoolArray) -> IntArray:
    """Return (start, stop) of each stretch of True, (r, 2)."""
    edges = np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))
    return np.column_stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)])


def mark(stretches: IntArray, frames: int) -> BoolArray:
    """Return which frames lie in one of some stretches (start, stop), (r, 2)."""
    out = np.zeros(frames, dtype=np.bool_)
    for start, stop in stretches:
        out[start:stop] = True
    return out


def find_stuck(series: FloatArray, good: BoolArray) -> BoolArray:
    """Find frames of a value that is held for longer than chance or quantisation hold it."""
    same = (series[1:] == series[:-1]) & good[1:] & good[:-1]
    ends = np.concatenate([[0], np.flatnonzero(~same) + 1, [len(series)]])
    stretches = np.column_stack([ends[:-1], ends[1:]])[good[ends[:-1]]]  # single values, too
    lengths = stretches[:, 1] - stretches[:, 0]
    # the chance that a value is held on: a slow series in steps stays on a level longer than its
    # mean run tells, so the largest one of any length counts
    longer = np.cumsum(np.bincount(lengths)[::-1])[::-1]  # runs of at least that length
    many = longer[1:] >= _MANY_RUNS
    chances = longer[2:][many[:-1]] / longer[1:-1][many[:-1]]
    chance = max(float(np.max(chances, initial=0.0)), np.finfo(float).tiny)
    least = np.inf if chance >= 1 else 1 + np.log(RARE / len(series)) / np.log(chance)
    return mark(stretches[lengths >= max(least, _SHORTEST_RUN)], len(series))


def find_saturated(series: FloatArray, good: BoolArray) -> BoolArray:
    """Find frames at an end of the range that is reached far more often than values beside it."""
    # zeros are those of an open loop
    good, out = good & (series != 0), np.zeros(len(series), dtype=np.bool_)
    values = series[good]
    span = float(np.ptp(values)) if values.size else 0.0
    if span == 0:
        return out
    tolerance = float(np.finfo(np.float32).eps) * span  # levels as single precision has them
    for sign in (1.0, -1.0):
        end = float(np.max(sign * values))
        upper = sign * values[sign * values > end - 0.25 * span]
        upper, ends = _sort_levels(upper, tolerance)
        if len(ends) <= _LIMIT_RATIO:  # of coarse numbers there are few
            upper, ends = _sort_levels(sign * values, tolerance)
        counts = np.diff(np.concatenate([[0], ends, [upper.size]]))[: _LIMIT_RATIO + 1]
        inside = int(np.max(counts[1:], initial=1))
        if counts[0] >= _LIMIT_RATIO * inside:
            out |= good & (sign * series >= end - tolerance)
    return out


def _sort_levels(values: FloatArray, tolerance: float) -> tuple[FloatArray, IntArray]:
    """Return the values from the largest down, and where each next level begins."""
    sorted_values = np.sort(values)[::-1]
    return sorted_values, np.flatnonzero(-np.diff(sorted_values) > tolerance) + 1


def find_outliers(series: FloatArray, good: BoolArray) -> BoolArray:
    """Find frames whose second difference is beyond what the series around shows.

    The scale is the median deviation of the second differences, that of the whole record or
    of the 256 frames around, whichever is larger: a burst of vibration is no outlier, and one
    value cannot raise the median. A strong sinusoid stays below its own scale.
    """
    good, out = good.copy(), np.zeros(len(series), dtype=np.bool_)
    if len(series) < 3:
        return out
    steps = np.abs(np.diff(series))[good[1:] & good[:-1]]
    smallest = float(np.min(steps[steps > 0], initial=np.inf)) / 2
    smallest = smallest if np.isfinite(smallest) else 0.0
    bend = np.abs(np.pad(series[:-2] - 2 * series[1:-1] + series[2:], 1))
    while True:
        valid = np.pad(good[:-2] & good[1:-1] & good[2:], 1)
        if not valid.any():
            break
        size = np.where(valid, bend, 0.0)
        scale = np.maximum(_local_scale(size, valid), smallest)
        outliers = valid & (size > _OUTLIER * scale) & (size >= 0.9 * maximum_filter1d(size, 3))
        if not outliers.any():
            break
        # a frame at an edge has no second difference: it may be the one that bends its neighbour
        outliers |= good & ~valid & maximum_filter1d(outliers, 3)
        out |= outliers
        good &= ~outliers
    if out.any():  # frames between outliers that are too few to be judged
        beside = maximum_filter1d(out, 3)
        stretches = runs(good)
        few = np.array([b - a < 3 and beside[a:b].any() for a, b in stretches], dtype=np.bool_)
        out |= mark(stretches[few], len(series))
    return out


def _local_scale(size: FloatArray, valid: BoolArray) -> FloatArray:
    """Return the scale of the second difference at each frame, at least that of the record."""
    frames = len(size)
    global_scale = MAD * float(np.median(size[valid]))
    blocks = -(-frames // _BLOCK)
    padded = np.full(blocks * _BLOCK, np.nan)
    padded[:frames] = np.where(valid, size, np.nan)
    table = padded.reshape(blocks, _BLOCK)
    enough = np.sum(np.isfinite(table), axis=1) >= _BLOCK // 4
    local = np.full(blocks, global_scale)
    if enough.any():
        local[enough] = np.maximum(global_scale, MAD * np.nanmedian(table[enough], axis=1))
    return np.repeat(maximum_filter1d(local, 3), _BLOCK)[:frames]


def fill(series: FloatArray, good: BoolArray) -> FloatArray:
    """Return the series with the frames that are not good filled by linear interpolation."""
    out = np.where(good, series, 0.0)
    if good.any() and not good.all():
        frames = np.arange(len(series))
        out[~good] = np.interp(frames[~good], frames[good], series[good])
    return out


@table_row
class Finding:
    """One kind of fault in one series."""

    kind: str = column("finding", help="Missing, repeated, not finite, stuck, saturated, ...")
    series: str = column("series", help="Measurements, commands or frames")
    axis: int | None = column("axis", help="From 0; None for all axes")
    count: int = column("frames", help="How many")
    fraction: float = percent_column("share", format=".4g", help="Their part of all frames")
    first_frame: int = column("first frame", help="The first of them")


def findings_in(
    faulty: BoolArray, kind: str, series: str, axis: int | None = None
) -> tuple[Finding, ...]:
    """Return the finding of a fault in some frames, (frames,); none where there are none."""
    where = np.flatnonzero(faulty)
    return tuple(
        Finding(
            kind=kind,
            series=series,
            axis=axis,
            count=where.size,
            first_frame=first,
            fraction=where.size / len(faulty),
        )
        for first in where[:1].tolist()
    )
