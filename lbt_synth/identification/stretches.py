"""Stretches of a record: frames that are usable, to fit on, and to test on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from lbt_synth.errors import ProblemError
from lbt_synth.validation import integer, number

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


def split_halves(
    stretches: StretchesLike | None, frames: int, *, fit_share: float = 0.5
) -> tuple[Stretches, Stretches]:
    """Split a record into frames to fit and later frames to test on.

    Parameters
    ----------
    stretches : sequence of (start, stop), or None
        Contiguous usable frames, in order; None for the whole record of so many ``frames``.
    frames : int
        Frames of the record.
    fit_share : float, optional
        Part of the usable frames that is fitted, in (0, 1).

    Returns
    -------
    tuple of ((start, stop), ...)
        Stretches of the fit and of the test.

    Raises
    ------
    ProblemError
        If the stretches do not fit the record, or a half is left without frames.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.identification.split_halves([(0, 400), (500, 900)], 1000, fit_share=0.25)
    (((0, 200),), ((200, 400), (500, 900)))
    """
    usable = checked_stretches(stretches, integer(frames, "frames", at_least=1))
    count = sum(stop - start for start, stop in usable)
    cut = int(number(fit_share, "fit_share", above=0, below=1) * count)
    if not 1 <= cut < count:
        raise ProblemError(
            f"a record must leave frames to fit and to test on; got {count} usable frames. Record "
            "more."
        )
    return cut_stretches(usable, 0, cut), cut_stretches(usable, cut, count)


def cut_stretches(stretches: Stretches, first: int, last: int) -> Stretches:
    """Return the usable frames from one count of them to another."""
    out, before = [], 0
    for start, stop in stretches:
        low, high = max(first - before, 0), min(last - before, stop - start)
        if low < high:
            out.append((start + low, start + high))
        before += stop - start
    return tuple(out)
