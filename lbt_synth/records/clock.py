"""Times and frame counters: the regular grid on which the frames of a record lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, IntArray, number, real_array

_SAME_RATE = 5e-3  # by which a stated rate may differ from that of the times
_CLEAR = 0.3  # of a frame: how far a step may be from a whole number of frames
_LATE = 0.45  # of a frame, for times with a jitter
_MOST_UNEVEN = 0.1  # of the steps over more than a frame, where the times tell the rate
_FEW_ROWS = 20  # of which no share is taken
_MOST_HOLES = 9  # missing frames over those that are there


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clock:
    """Where each row of a record lies.

    Attributes
    ----------
    frame_rate_hz : float
        Frame rate [Hz].
    frame_of_row : (rows,) int ndarray
        Frame of each row, from 0, never falling; equal for rows of the same time.
    frames : int
        Frames from the first to the last row.
    notes : tuple of str
        What was found.
    """

    frame_rate_hz: float
    frame_of_row: IntArray
    frames: int
    notes: tuple[str, ...] = field(default=())


def clock_of(
    rows: int,
    *,
    frame_rate_hz: float | None,
    times_s: FloatArray | None = None,
    frame_numbers: FloatArray | None = None,
) -> Clock:
    """Lay rows on a regular grid.

    Parameters
    ----------
    rows : int
        Rows of the record.
    frame_rate_hz : float or None
        Frame rate [Hz], where it is stated.
    times_s : (rows,) array_like, optional
        Time of each row [s].
    frame_numbers : (rows,) array_like, optional
        Counter of frames, of each row.

    Returns
    -------
    Clock
        The grid.

    Raises
    ------
    ProblemError
        If there is no rate, the times contradict it, times or counters run backwards, or
        they lie on no regular grid.
    """
    rate = None if frame_rate_hz is None else number(frame_rate_hz, "frame_rate_hz", above=0)
    notes: list[str] = []
    frame = np.arange(rows)
    times = None if times_s is None else _rising(times_s, "times_s", rows)
    if frame_numbers is not None:
        frame = _counted(_rising(frame_numbers, "frame_numbers", rows))
    if times is not None and rows > 1:
        if frame_numbers is None:
            frame = _on_grid(times, rate)
        found = _rate_of(times, frame)
        if rate is None:
            rate = found
            notes.append(f"frame rate {rate:.9g} Hz, from the times")
            uneven = float(np.mean(np.diff(frame) > 1))
            if frame_numbers is None and rows > _FEW_ROWS and uneven > _MOST_UNEVEN:
                raise ProblemError(
                    f"{100 * uneven:.3g} % of the steps in time would leave frames out at "
                    f"{rate:.6g} Hz, the rate by the median step: the times may be rounded. Give "
                    "frame_rate_hz."
                )
        elif abs(found / rate - 1) > _SAME_RATE:
            raise ProblemError(
                f"frame_rate_hz must be that of the times, {found:.9g} Hz; got {rate:.9g} Hz. "
                "Leave it away, or leave the times away."
            )
    if rate is None:
        raise ProblemError("the frame rate is not known; give frame_rate_hz, or the times.")
    frames = int(frame[-1]) + 1
    if frames > (1 + _MOST_HOLES) * rows:
        raise ProblemError(
            f"{frames - rows} of {frames} frames would be missing between the first row and the "
            "last; cut the record where it was interrupted."
        )
    return Clock(frame_rate_hz=rate, frame_of_row=frame, frames=frames, notes=tuple(notes))


def first_per_frame(
    clock: Clock, same: Callable[[IntArray], bool]
) -> tuple[IntArray, IntArray, int]:
    """Return the rows to keep, the frames that are contradicted, and how many rows are left out.

    Parameters
    ----------
    clock : Clock
        The grid.
    same : callable
        Whether the rows of these indices all hold the same values.
    """
    again = np.flatnonzero(np.diff(clock.frame_of_row) == 0) + 1
    keep = np.setdiff1d(np.arange(len(clock.frame_of_row)), again)
    torn = [
        int(frame)
        for frame in np.unique(clock.frame_of_row[again])
        if not same(np.flatnonzero(clock.frame_of_row == frame))
    ]
    return keep, np.array(torn, dtype=np.int64), again.size


def _rising(values: FloatArray, name: str, rows: int) -> FloatArray:
    out = real_array(values, name)
    if out.shape != (rows,):
        raise DimensionError(
            f"{name} must have shape ({rows},), one a frame of the measurements; got {out.shape}."
        )
    back = np.flatnonzero(np.diff(out) < 0)
    if back.size:
        k = int(back[0])
        raise ProblemError(
            f"{name} must not run backwards; got {out[k]:.12g} and then {out[k + 1]:.12g} at row "
            f"{k + 1}. Cut the record there, or sort its rows."
        )
    return out


def _counted(numbers: FloatArray) -> IntArray:
    if not np.array_equal(numbers, np.round(numbers)):
        raise ProblemError("frame_numbers must be whole numbers; got fractions.")
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    if steps.size and np.median(steps) != 1:
        raise ProblemError(
            "frame_numbers must mostly rise by 1 a row; got a median step of "
            f"{np.median(steps):.6g}. A record of every second frame is one of half the rate."
        )
    return np.asarray(numbers - numbers[0], dtype=np.int64)


def _on_grid(times: FloatArray, rate: float | None) -> IntArray:
    steps = np.diff(times)
    rising = steps[steps > 0]
    if rising.size == 0:
        raise ProblemError("times_s must rise; all rows have the same time.")
    period = float(np.median(rising)) if rate is None else 1 / rate
    if rising.size == len(steps) and np.ptp(steps) < 2 * _CLEAR * float(np.median(steps)):
        # no frame is missing, whatever the rate is: that is compared afterwards
        return np.arange(len(times))
    if rate is not None:  # times may be rounded, or jitter
        grid = (times - times[0]) * rate
        grid = grid - np.median(grid - np.round(grid))
        frame = np.round(grid)
        if np.all(np.abs(grid - frame) < _LATE) and np.all(np.diff(frame)[steps > 0] > 0):
            return np.asarray(frame - frame[0], dtype=np.int64)
    counts = np.round(steps / period)
    if np.all(np.abs(steps / period - counts) < _CLEAR):
        return np.asarray(np.concatenate([[0], np.cumsum(counts)]), dtype=np.int64)
    k = int(np.argmax(np.abs(steps / period - counts)))
    raise ProblemError(
        f"times_s lie on no regular grid of {1 / period:.6g} Hz; row {k + 1} comes "
        f"{steps[k] / period:.3g} frames after the one before. Give frame_rate_hz, a counter of "
        "frames, or leave the times away."
    )


def _rate_of(times: FloatArray, frame: IntArray) -> float:
    """Rate by a straight line through times and frames, to nine digits."""
    t, n = times - times.mean(), frame - frame.mean()
    slope = float(n @ t)
    if not slope > 0:
        raise ProblemError("times_s must rise; all rows have the same time.")
    return float(f"{float(n @ n) / slope:.9g}")
