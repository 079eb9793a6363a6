"""Commands that stand still in the record although the mirror moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.records.faults import equal_runs, mark, runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_SEGMENT = 256  # frames whose spectrum is taken
_LEAST_SEGMENTS = 4
_BANDS = 20
_CLEAR = 20.0  # nats that decide


def held_while_moving(record: LoopRecord) -> str:
    """Say in how many frames the commands stand still while the mirror moved; empty if in none.

    A mirror that stands still leaves the measurements of an open loop, whose spectrum is that of
    the pseudo-open loop in the other frames. If those of the closed loop explain them better, the
    record of the commands stopped, not the mirror.
    """
    assert record.commands is not None
    corrections = past_corrections(record.mirror_taps, record.commands)
    still = np.array([_still(column, record.usable) for column in corrections.T])
    if not np.any(still):
        return ""
    moving = CoarseRecord(replace(record, usable=record.usable & ~np.any(still, axis=0)))
    if not moving.stretches:
        return ""
    gains = moving.compare([Guess(kind="as given")]).gain[:, 0]
    opened = record.measurements + gains * corrections
    nats = sum(
        _excess(*axis)
        for axis in zip(record.measurements.T, opened.T, still, still ^ record.usable, strict=True)
    )
    if nats < _CLEAR:
        return ""
    share = 100 * float(np.max(np.mean(still, axis=1)))
    return (
        f"they stand still in {share:.0f} % of the frames, where the "
        "measurements are those of a loop that runs. Cut these frames off, or record them again"
    )


def _still(correction: FloatArray, usable: BoolArray) -> BoolArray:
    """Return the frames of long stretches in which a correction does not move."""
    each = equal_runs(correction, usable)
    return mark(each[each[:, 1] - each[:, 0] >= _SEGMENT], len(correction))


def _excess(closed: FloatArray, opened: FloatArray, still: BoolArray, moving: BoolArray) -> float:
    """Return by how many nats the closed loop explains the measurements of held frames better."""
    held, free = _segments(still), _segments(moving)
    if min(len(held), len(free)) < _LEAST_SEGMENTS:
        return 0.0
    seen = _spectrum(closed[held])
    if not np.all(seen > 0):  # nothing is measured there
        return 0.0
    own, other = (
        len(held) * np.sum(np.log(S) + seen / S)
        for S in (_spectrum(closed[free]), _spectrum(opened[free]))
    )
    return float(other - own)


def _segments(frames: BoolArray) -> IntArray:
    """Return the frames of each whole segment of stretches, (segments, frames)."""
    starts = [
        first
        for start, stop in runs(frames)
        for first in range(start, stop - _SEGMENT + 1, _SEGMENT)
    ]
    return np.array(starts, dtype=np.int64)[:, None] + np.arange(_SEGMENT)


def _spectrum(segments: FloatArray) -> FloatArray:
    """Return the mean power in each of some bands, but for the mean, (bands,)."""
    window = np.hanning(_SEGMENT + 1)[:-1]
    transforms = np.fft.rfft((segments - segments.mean(axis=1, keepdims=True)) * window)
    power = np.mean(np.abs(transforms[:, 2:]) ** 2, axis=0)
    edges = np.unique(np.geomspace(1, power.size, _BANDS).astype(np.int64)) - 1
    return np.asarray(np.add.reduceat(power, edges) / np.diff(edges, append=power.size))
