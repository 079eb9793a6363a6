"""Stretches of a record: frames that are usable, to fit on, and to test on."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
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
    stretches: StretchesLike | None, frames: int, *, gap_frames: int = 0, fit_share: float = 0.5
) -> tuple[Stretches, Stretches]:
    """Split a record into frames to fit and later frames to test on, with a gap between them.

    Parameters
    ----------
    stretches : sequence of (start, stop), or None
        Contiguous usable frames, in order; None for the whole record.
    frames : int
        Frames of the record.
    gap_frames : int, optional
        Frames after the last one of the fit that neither half has, so that the test does not
        know the end of the fit.
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
    >>> lbt.identification.split_halves([(0, 400), (500, 900)], 1000, gap_frames=20)
    (((0, 400),), ((500, 900),))
    >>> lbt.identification.split_halves(None, 1000, gap_frames=20)
    (((0, 500),), ((520, 1000),))
    """
    pairs = checked_stretches(stretches, integer(frames, "frames", at_least=1))
    gap = integer(gap_frames, "gap_frames", at_least=0)
    share = number(fit_share, "fit_share", above=0, below=1)
    wanted = int(share * sum(stop - start for start, stop in pairs))
    fit, test, taken, end = [], [], 0, 0
    for start, stop in pairs:
        edge = min(start + wanted - taken, stop)
        if edge > start:
            fit.append((start, edge))
            taken, end = taken + edge - start, edge
        after = max(start, edge, end + gap)
        if taken == wanted and after < stop:
            test.append((after, stop))
    if not fit or not test:
        raise ProblemError(
            f"a record must leave frames to fit and to test on; got {len(fit)} stretches to fit "
            f"and {len(test)} to test, of {frames} frames with a gap of {gap}. Record for longer."
        )
    return tuple(fit), tuple(test)


def split_frames(
    stretches: StretchesLike | None,
    fit: StretchesLike | None,
    test: StretchesLike | None,
    frames: int,
) -> tuple[Stretches, Stretches, Stretches]:
    """Return contiguous frames, and those of them to fit and to test on.

    Fit and test are as given, or the halves of the contiguous frames; without those, fit and test
    are contiguous where they touch.
    """
    usable = checked_stretches(stretches, frames)
    if fit is None and test is None:
        return usable, *split_halves(usable, frames)
    if fit is None or test is None:
        raise ProblemError("fit and test must both be given, or neither; got one of them.")
    fitted, tested = checked_stretches(fit, frames), checked_stretches(test, frames)
    for (a, b), (c, d) in product(fitted, tested):
        if a < d and c < b:
            raise ProblemError(
                f"the test must have frames that the fit has not; got ({a}, {b}) to fit and "
                f"({c}, {d}) to test."
            )
    return usable if stretches is not None else _join((*fitted, *tested)), fitted, tested


def _join(parts: Stretches) -> Stretches:
    """Return the union of stretches that do not overlap."""
    out: list[tuple[int, int]] = []
    for start, stop in sorted(parts):
        begin = out.pop()[0] if out and out[-1][1] == start else start
        out.append((begin, stop))
    return tuple(out)
