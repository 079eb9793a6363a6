"""The clock of a record: its rows on a regular grid of frames, by frame counters or times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, IntArray, number, real_array

_SAME_RATE = 1e-4  # by which a stated rate may differ from that of the times: a cheap clock
_MOST_HOLES = 9  # missing frames over those that are there; more fill the memory
_CLEAR = 0.45  # of a frame, by which the steps of complete rows may differ
_NARROW = 0.1  # of a frame, or of the steps: what is less is jitter, or chance
_COARSE = 0.02  # of a frame: times in smaller steps are not rounded, but jitter
_FEW = 3  # odd steps that show an order


class Clock(NamedTuple):
    """Where each row of a record lies."""

    frame_rate_hz: float
    frame_of_row: IntArray  # (rows,), from 0, never falling; equal for rows of the same time
    notes: list[str]
    jitter_frames: float | None = None  # rms distance of the times from the grid; None without any


def build_clock(
    rows: int,
    *,
    frame_rate_hz: float | None,
    times_s: ArrayLike | None = None,
    frame_numbers: ArrayLike | None = None,
) -> Clock:
    """Lay rows on a regular grid, by their frame numbers (rows,) or times (rows,).

    Times that stand still, or whose steps are longer than a frame, are not used beside a rate.
    """
    rate = None if frame_rate_hz is None else number(frame_rate_hz, "frame_rate_hz", above=0)
    times = None if times_s is None else _check_rising(times_s, "times_s", rows)
    frame = np.arange(rows)
    if frame_numbers is not None:
        frame = _frames_from_counter(_check_rising(frame_numbers, "frame_numbers", rows))
    notes: list[str] = []
    times = times if rows > 1 else None
    if times is not None and rate is not None and _tell_nothing(times, rate):
        times, notes = None, ["the times do not tell frames apart and were not used"]
    if times is None:
        if rate is None:
            raise ProblemError("the frame rate is not known; give frame_rate_hz, or the times.")
        return Clock(rate, frame, notes)
    if frame_numbers is None:
        frame = _frames_from_times(times, rate)
    rate_of_times, off = _fit_rate(times, frame)
    if rate is None:
        rate, notes = rate_of_times, [f"frame rate {rate_of_times:.9g} Hz, from the times"]
    else:
        notes = _compare_rates(rate, rate_of_times, int(frame[-1]), float(np.ptp(off)))
    return Clock(rate, frame, notes, float(np.std(off)) if rows > 2 else None)


def _tell_nothing(times: FloatArray, rate: float) -> bool:
    """Return whether rows share times that stand still or rise by frames at once, as seconds do.

    The number of rows must be that of the rate.
    """
    frames, stamps = float(times[-1] - times[0]) * rate, int(np.sum(np.diff(times) > 0))
    if not frames or stamps == len(times) - 1:
        return not frames
    is_complete = abs(frames - (len(times) - 1)) <= frames / stamps
    return is_complete and _step(times, rate) > 1


def _compare_rates(rate: float, rate_of_times: float, frames: int, loose: float) -> list[str]:
    """Note how far a stated rate is from that of the times; refuse a contradiction.

    ``loose`` frames are what rounding and jitter move the times by.
    """
    apart = abs(rate_of_times / rate - 1) * frames
    if apart > 1 + _SAME_RATE * frames + loose:
        raise ProblemError(
            f"frame_rate_hz must be that of the times, {rate_of_times:.9g} Hz; got {rate:.9g} Hz: "
            f"{apart:.3g} frames apart over the record. Leave it away, or leave the times away."
        )
    if apart > 0.5 + loose:
        return [
            f"frame rate {rate:.9g} Hz, as stated; by the times {rate_of_times:.9g} Hz, "
            f"{apart:.3g} frames apart over the record"
        ]
    return []


def _check_rising(values: ArrayLike, name: str, rows: int) -> FloatArray:
    """Return the times or counters of all rows; refuse those that run backwards."""
    out = real_array(values, name)
    if out.shape != (rows,):
        raise DimensionError(
            f"{name} must have shape ({rows},), one per frame of the measurements; got {out.shape}."
        )
    back = np.flatnonzero(np.diff(out) < 0)
    if back.size:
        k = int(back[0])
        raise ProblemError(
            f"{name} must not run backwards; got {out[k]:.12g} and then {out[k + 1]:.12g} at row "
            f"{k + 1}. Cut the record there, or sort its rows."
        )
    return out


def _frames_from_counter(numbers: FloatArray) -> IntArray:
    """Return the frame of each row, from 0, by a counter."""
    if not np.array_equal(numbers, np.round(numbers)):
        raise ProblemError("frame_numbers must be whole numbers; got fractions.")
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    if steps.size and np.median(steps) != 1:
        raise ProblemError(
            "frame_numbers must mostly rise by 1 per row; got a median step of "
            f"{np.median(steps):.6g}. A record of every second frame is one of half the rate."
        )
    _require_few_holes(float(numbers[-1]) - float(numbers[0]) + 1, len(numbers))
    return np.asarray(numbers - numbers[0], dtype=np.int64)


def _require_few_holes(frames: float, rows: int) -> None:
    """Refuse a record that would be nearly all holes."""
    if frames > (1 + _MOST_HOLES) * rows:
        raise ProblemError(
            f"{frames - rows:.15g} of {frames:.15g} frames would be missing between the first row "
            "and the last; cut the record where it was interrupted."
        )


def _frames_from_times(times: FloatArray, rate: float | None) -> IntArray:
    """Return the frame of each row, from 0, by times."""
    steps = np.diff(times)
    rising = steps[steps > 0]
    if rising.size == 0:
        raise ProblemError("times_s must rise; all rows have the same time.")
    period = float(np.median(rising)) if rate is None else 1 / rate
    _require_few_holes(float(times[-1] - times[0]) / period + 1, len(times))
    if rising.size == len(steps) and np.ptp(steps) < _CLEAR * float(np.median(steps)):
        # no frame is missing, whatever the rate is: that is compared afterwards
        return np.arange(len(times))
    return _lay_by_steps(times, period) if rate is None else _lay_by_rate(times, rate)


def _lay_by_steps(times: FloatArray, period: float) -> IntArray:
    """Lay rows by the steps in time, for an unknown rate."""
    steps = np.diff(times) / period
    counts = np.round(steps)
    away = np.abs(steps - counts)
    if np.any(away >= _CLEAR / 2):
        k = int(np.argmax(away))
        raise ProblemError(
            f"times_s lie on no regular grid of {1 / period:.6g} Hz; row {k + 1} comes "
            f"{steps[k]:.3g} frames after the one before. Give frame_rate_hz, a counter of frames, "
            "or leave the times away."
        )
    rate, off = _fit_rate(times, np.arange(len(times)))
    odd = int(np.sum(counts != 1)) if _quantum(times) > _COARSE * period else 0
    if odd >= _FEW and (odd > _NARROW * len(times) or np.ptp(off) < 1.2 * rate * period):
        raise ProblemError(
            f"the steps in time are those of missing or repeated frames at {1 / period:.6g} Hz, or "
            f"of no such frame at {rate:.6g} Hz: the times may be rounded. Give frame_rate_hz."
        )
    return np.asarray(np.concatenate([[0], np.cumsum(counts)]), dtype=np.int64)


def _lay_by_rate(times: FloatArray, rate: float) -> IntArray:
    """Lay rows on the grid of a known rate, where one layout alone explains their times.

    Rounded to a step, the times of a layout stay within the step of a straight line. Each gap
    among the parts of a frame at which rows come may be the one where frames begin.
    """
    place, step = (times - times[0]) * rate, _step(times, rate)
    slack = _slack(times, rate)
    parts = np.sort(place % 1)
    gaps = np.diff(np.append(parts, parts[0] + 1))
    wide = np.flatnonzero(gaps > 1 - step - slack)
    if step <= _COARSE:
        wide = np.flatnonzero(gaps == max(np.max(gaps), _NARROW))
    layouts: list[FloatArray] = []
    for k in wide if step < 1 else ():
        frame = np.floor(place - (parts[k] + gaps[k] / 2))
        frame -= frame[0]
        is_new = not any(np.array_equal(frame, layout) for layout in layouts)
        if is_new and not np.any(np.diff(frame)[np.diff(times) > 0] <= 0):
            layouts.append(frame)
        if len(layouts) > 1:
            break
    if len(layouts) != 1:
        raise ProblemError(
            f"times_s in steps of {_quantum(times):.6g} s cannot tell which frames are missing or "
            f"repeated on the grid of {rate:.9g} Hz. Give a counter of frames, or leave the times "
            "away."
        )
    return np.asarray(layouts[0], dtype=np.int64)


def _step(times: FloatArray, rate: float) -> float:
    """Return the step to which times are rounded [frames]; 0 of exact ones, in whole frames."""
    step = _quantum(times) * rate
    return 0.0 if abs(step - 1) * len(times) < _slack(times, rate) else step


def _slack(times: FloatArray, rate: float) -> float:
    """Return what double precision leaves open of times [frames]."""
    return 1e-6 + 16 * rate * float(np.spacing(np.max(np.abs(times))))


def _quantum(times: FloatArray) -> float:
    """Return the quantum of the steps in time, the smallest difference between two of them."""
    noise = 8 * float(np.spacing(np.max(np.abs(times))))
    steps = np.diff(times)
    gaps = np.diff(np.unique(np.append(0.0, steps)))
    counts = np.round(steps / float(np.min(gaps[gaps > noise])))
    return float(times[-1] - times[0]) / float(np.sum(counts))


def _fit_rate(times: FloatArray, frame: IntArray) -> tuple[float, FloatArray]:
    """Return the rate by a straight line through times and frames, to nine digits.

    And how far each time is from that line [frames], (rows,).
    """
    t, n = times - times.mean(), frame - frame.mean()
    slope = float(n @ t)
    if not slope > 0:
        raise ProblemError("times_s must rise; all rows have the same time.")
    rate = float(n @ n) / slope
    return float(f"{rate:.9g}"), rate * t - n
