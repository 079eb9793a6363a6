"""Single outliers of a pseudo-open-loop series, which would look like noise in a fit."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.records.faults import fill, find_outliers, runs
from lbt_synth.validation import BoolArray, FloatArray

_APART = 10  # frames between two glitches; nearer ones are echoes in a loop of another gain


def find_glitches(open_loop: FloatArray) -> BoolArray:
    """Return the frames with an outlier in any column of a pseudo-open-loop series.

    That series (frames, q) does not show what a glitch does to the commands, but the glitch itself
    bends it as nothing around does (see ``records.faults.find_outliers``).

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.identification.tracking.glitches import find_glitches
    >>> series = np.random.default_rng(0).standard_normal((1000, 1))
    >>> series[300] = 100
    >>> np.flatnonzero(find_glitches(series)).tolist()
    [300]
    """
    every = np.ones(len(open_loop), dtype=np.bool_)
    found = [find_outliers(column, every) for column in open_loop.T]
    return np.asarray(np.any(found, axis=0))


def stand_alone(flags: BoolArray, delay_frames: float) -> bool:
    """Whether glitches are short and far from each other.

    A glitch ends before its own command comes back. Otherwise the sensor gain differs from the
    model's, the series also shows the response to the glitch, and must not be left out in part.
    """
    each = runs(flags)
    lengths, gaps = each[:, 1] - each[:, 0], each[1:, 0] - each[:-1, 1]
    return bool(np.all(lengths <= max(1, int(delay_frames))) and np.all(gaps >= _APART))


def bridge_frames(series: FloatArray, flags: BoolArray) -> FloatArray:
    """Return a series (frames, q) with the frames that are flagged interpolated linearly."""
    return np.column_stack([fill(column, ~flags) for column in series.T])
