"""Frames of a record: all that are usable, or a part of them, to fit on or to test on."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.faults import mark
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import BoolArray

Stretches: TypeAlias = tuple[tuple[int, int], ...]  # (start, stop) of contiguous usable frames


def keep_frames(record: LoopRecord, kept: BoolArray) -> LoopRecord:
    """Return a record of which no other frames (frames,) are usable."""
    bridges = None if record.bridges is None else record.bridges & kept
    return replace(record, measured=record.measured & kept, bridges=bridges)


def split_halves(record: LoopRecord) -> tuple[LoopRecord, LoopRecord]:
    """Return a record with the first half of its usable frames, to fit, and the rest, to test."""
    runs = record.stretches()
    count = int(np.sum(record.usable))
    if count < 2:
        raise ProblemError(
            f"a record must leave frames to fit and to test on; got {count} usable frames. Record "
            "more."
        )
    first = mark(np.array(cut_stretches(runs, 0, count // 2)), record.frames)
    return keep_frames(record, first), keep_frames(record, ~first)


def cut_stretches(stretches: Stretches, first: int, last: int) -> Stretches:
    """Return the usable frames from one count of them to another."""
    out, before = [], 0
    for start, stop in stretches:
        low, high = max(first - before, 0), min(last - before, stop - start)
        if low < high:
            out.append((start + low, start + high))
        before += stop - start
    return tuple(out)
