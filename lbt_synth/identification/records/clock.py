"""The clock of a record: its rows on a regular grid of frames, by frame counters or times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, IntArray, number, real_array

SAME_FRAME = 0.45  # of a frame, by which the step between two times may be off: less than half
_EXACT = 0.02  # of a frame, within which all times of exact stamps lie on the grid of their rate
_SAME_RATE = 1e-4  # by which a stated rate may differ from that of the times: a cheap clock
_MOST_HOLES = 9  # missing frames over those that are there; more fill the memory


class Clock(NamedTuple):
    """Where each row of a record lies."""

    frame_rate_hz: float
    frame_of_row: IntArray  # (rows,), from 0, never falling; equal for rows of the same time
    notes: list[str]


def build_clock(
    rows: int,
    *,
    frame_rate_hz: float | None,
    times_s: ArrayLike | None = None,
    frame_numbers: ArrayLike | None = None,
) -> Clock:
    """Lay rows on a regular grid, by their frame numbers (rows,) or times (rows,)."""
    rate = None if frame_rate_hz is None else number(frame_rate_hz, "frame_rate_hz", above=0)
    times = None if times_s is None else _check_rising(times_s, "times_s", rows)
    frame = np.arange(rows)
    if frame_numbers is not None:
        numbers = _check_rising(frame_numbers, "frame_numbers", rows)
        if not np.array_equal(numbers, np.round(numbers)):
            raise ProblemError("frame_numbers must be whole numbers; got fractions.")
        _require_few_holes(float(numbers[-1]) - float(numbers[0]) + 1, rows)
        frame = np.asarray(numbers - numbers[0], dtype=np.int64)
    if times is None or rows == 1:
        if rate is None:
            raise ProblemError("the frame rate is not known; give frame_rate_hz, or the times.")
        return Clock(rate, frame, [])
    if frame_numbers is None:
        frame = _frames_from_times(times, rate)
    t, n = times - times.mean(), frame - frame.mean()
    slope = float(n @ n) / float(n @ t)  # of a straight line
    rate_of_times, off = float(f"{slope:.9g}"), slope * t - n  # the second in frames
    notes = [] if rate is not None else [f"frame rate {rate_of_times:.9g} Hz, from the times"]
    rate = rate_of_times if rate is None else rate
    frames = float(frame[-1])
    apart = abs(rate_of_times / rate - 1) * frames
    if apart > 1 + _SAME_RATE * frames + float(np.ptp(off)):  # what rounding and jitter move
        raise ProblemError(
            f"frame_rate_hz must be that of the times, {rate_of_times:.9g} Hz; got {rate:.9g} Hz: "
            f"{apart:.3g} frames apart over the record. Leave it away, or leave the times away."
        )
    if (jitter := float(np.std(off))) > _EXACT:
        notes.append(f"the times lie {jitter:.2g} frames rms beside a regular grid")
    return Clock(rate, frame, notes)


def _check_rising(values: ArrayLike, name: str, rows: int) -> FloatArray:
    """Return the times or counters of all rows; refuse those that run backwards."""
    out = real_array(values, name)
    if out.shape != (rows,):
        raise DimensionError(
            f"{name} must have shape ({rows},), one per frame of the measurements; got {out.shape}."
        )
    if rows > 1 and np.all(out == out[0]):
        raise ProblemError(f"{name} must rise from row to row; all rows have {out[0]:.12g}.")
    back = np.flatnonzero(np.diff(out) < 0)
    if back.size:
        k = int(back[0])
        raise ProblemError(
            f"{name} must not run backwards; got {out[k]:.12g} and then {out[k + 1]:.12g} at row "
            f"{k + 1}. Cut the record there, or sort its rows."
        )
    return out


def _require_few_holes(frames: float, rows: int) -> None:
    """Refuse a record that would be nearly all holes."""
    if frames > (1 + _MOST_HOLES) * rows:
        raise ProblemError(
            f"{frames - rows:.15g} of {frames:.15g} frames would be missing between the first row "
            "and the last; cut the record where it was interrupted."
        )


def _frames_from_times(times: FloatArray, rate: float | None) -> IntArray:
    """Return the frame of each row, from 0, by times, which are exact or rounded."""
    steps, complete = np.diff(times), np.arange(len(times))
    if np.ptp(steps) < SAME_FRAME * float(np.median(steps)):
        return complete  # whatever the rate is: that is compared afterwards
    period = float(np.median(steps[steps > 0])) if rate is None else 1 / rate
    _require_few_holes(float(times[-1] - times[0]) / period + 1, len(times))
    rounding, place = _quantum(times) / period, (times - times[0]) / period
    if rate is not None:
        grid = np.round(place)  # of exact times
        if rounding < 1 + SAME_FRAME and np.max(np.abs(place - grid)) <= _EXACT:
            return np.asarray(grid, dtype=np.int64)
        slack = 1e-6 + 16 * float(np.spacing(np.max(np.abs(times)))) / period
        late = place - complete
        # a frame lost before a row is hidden if all later rows are later, by 1 less the rounding
        ahead = np.minimum.accumulate(late[::-1])[-2::-1] - np.maximum.accumulate(late)[:-1]
        hides = rounding > SAME_FRAME and bool(np.any(ahead >= 1 - rounding - slack))
        if np.ptp(late) <= max(rounding + slack, SAME_FRAME) and rounding < 1 and not hides:
            return complete
    if rounding > SAME_FRAME:
        advice = "frame_rate_hz" if rate is None else "a counter of frames"
        raise ProblemError(
            f"times_s in steps of {_quantum(times):.6g} s may be rounded: they cannot tell which "
            f"frames are missing or repeated at {1 / period:.9g} Hz. Give {advice}, or leave the "
            "times away."
        )
    counts = np.round(steps / period)
    away = np.abs(steps / period - counts)
    if np.any(away >= SAME_FRAME):
        k = int(np.argmax(away))
        raise ProblemError(
            f"times_s lie on no regular grid of {1 / period:.6g} Hz; row {k + 1} comes "
            f"{steps[k] / period:.3g} frames after the one before. Give the right frame_rate_hz, a "
            "counter of frames, or leave the times away."
        )
    return np.asarray(np.concatenate([[0], np.cumsum(counts)]), dtype=np.int64)


def _quantum(times: FloatArray) -> float:
    """Return the quantum of the steps in time, the smallest difference between two of them."""
    noise = 8 * float(np.spacing(np.max(np.abs(times))))
    steps = np.diff(times)
    gaps = np.diff(np.unique(np.append(0.0, steps)))
    counts = np.round(steps / float(np.min(gaps[gaps > noise])))
    return float(times[-1] - times[0]) / float(np.sum(counts))
