"""Stretches of a record: frames that are usable, to fit on, and to test on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from lbt_synth.errors import ProblemError
from lbt_synth.validation import integer

Stretches: TypeAlias = tuple[tuple[int, int], ...]
StretchesLike: TypeAlias = Sequence[tuple[int, int]]


def checked_stretches(stretches: StretchesLike | None, frames: int) -> Stretches:
    """Return stretches as pairs of integers; the whole record for None."""
    if stretches is None:
        return ((0, frames),)
    out: list[tuple[int, int]] = []
    for pair in stretches:
        if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
            raise ProblemError(f"a stretch must be a pair (start, stop) of frames; got {pair!r}.")
        start, stop = (integer(end, "the end of a stretch", at_least=0) for end in pair)
        after = out[-1][1] if out else 0
        if not after <= start < stop <= frames:
            raise ProblemError(
                f"stretches must be in order, apart, not empty and within {frames} frames; got "
                f"({start}, {stop}) after frame {after}."
            )
        out.append((start, stop))
    if not out:
        raise ProblemError("there must be at least one stretch of usable frames; got none.")
    return tuple(out)


def split_halves(stretches: Stretches) -> tuple[Stretches, Stretches]:
    """Split the usable frames of a record into those to fit and later ones to test on."""
    count = sum(stop - start for start, stop in stretches)
    if count < 2:
        raise ProblemError(
            f"a record must leave frames to fit and to test on; got {count} usable frames. Record "
            "more."
        )
    return cut_stretches(stretches, 0, count // 2), cut_stretches(stretches, count // 2, count)


def cut_stretches(stretches: Stretches, first: int, last: int) -> Stretches:
    """Return the usable frames from one count of them to another."""
    out, before = [], 0
    for start, stop in stretches:
        low, high = max(first - before, 0), min(last - before, stop - start)
        if low < high:
            out.append((start + low, start + high))
        before += stop - start
    return tuple(out)
