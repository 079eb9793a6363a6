"""The clock of a record: its rows on a regular grid of frames, by times or frame counters."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, IntArray, number, real_array

_MOST_APART = 5e-3  # by which a stated rate may differ from that of the times at all
_SAME_RATE = 1e-4  # by which it may differ in a record of any length
_SAME_FRAMES = 3.0  # by which it may differ over the record, if that is more
_SAID_FRAMES = 0.5  # over the record, beyond which a difference is noted
_MOST_UNEVEN = 0.1  # of the steps, longer than a frame, if the times give the rate
_FEW_ROWS = 20  # too few for that share
_HIGHEST_HZ = 1e9  # far beyond any loop
_MOST_HOLES = 9  # missing frames over those that are there
_CLEAR = 0.3  # of a frame, by which a step may differ from a whole number of frames
_LEAST_GAP = 0.1  # of a frame, between the latest and the earliest row of a frame
_COARSE = 0.02  # of a frame: times in smaller steps count as exact
_WHOLE = 0.02  # of a step, by which times may differ from whole ones
_EXACT = 0.05  # of a frame over the record, below which quantum and period are one
_ABOVE = 1.05  # quantum over period above which different frames have equal times
_FEW = 3  # odd steps that show an order
_DENOMINATOR = 100_000
_BLOCKS = 16  # of rows, whose mean distance from the grid is compared
_SEARCH = 60
_ROWS_PER_STAMP = 5  # of times that are too coarse to be used beside a rate


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
    """Lay rows on a regular grid, by their times (rows,) or frame numbers (rows,)."""
    rate = None
    if frame_rate_hz is not None:
        rate = number(frame_rate_hz, "frame_rate_hz", above=0, at_most=_HIGHEST_HZ)
    notes: list[str] = []
    frame = np.arange(rows)
    times = None if times_s is None else _check_rising(times_s, "times_s", rows)
    if times is not None and rate is not None and _tell_nothing(times, rate):
        times, notes = None, ["the times do not tell frames apart and were not used"]
    if frame_numbers is not None:
        frame = _frames_from_counter(_check_rising(frame_numbers, "frame_numbers", rows))
    if times is not None and rows > 1:
        if frame_numbers is None:
            frame, notes = _frames_from_times(times, rate)
        found = _fit_rate(times, frame)
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
        else:
            notes += _compare_rates(rate, found, times, frame)
    if rate is None:
        raise ProblemError("the frame rate is not known; give frame_rate_hz, or the times.")
    return Clock(rate, frame, notes, None if times is None else _jitter(times, frame))


def _tell_nothing(times: FloatArray, rate: float) -> bool:
    """Return whether times stand still, or rise by many frames at once, as whole seconds do.

    Their number of rows must be that of the rate.
    """
    steps = np.diff(times)
    if not np.any(steps > 0):
        return len(times) > 1
    stamps = int(np.count_nonzero(steps > 0))
    span = float(times[-1] - times[0])
    apart = abs(span * rate / len(times) - 1)
    return stamps * _ROWS_PER_STAMP < len(times) and apart <= 1 / stamps


def _jitter(times: FloatArray, frame: IntArray) -> float | None:
    """Return the rms distance of times from the closest grid of their frames [frames]."""
    if len(times) < 3 or frame[-1] == 0:
        return None
    t, n = times - times.mean(), frame - frame.mean()
    slope = float(n @ t) / float(n @ n)
    return float(np.sqrt(np.mean((t / slope - n) ** 2))) if slope > 0 else None


def _compare_rates(rate: float, found: float, times: FloatArray, frame: IntArray) -> list[str]:
    """Note how far a stated rate is from that of the times; refuse a contradiction."""
    span = max(int(frame[-1]), 1)
    loose = float(np.ptp((times - times[0]) * found - frame))  # rounding, jitter
    apart = abs(found / rate - 1) * span
    most = min(max(_SAME_RATE * span, _SAME_FRAMES + loose), max(_MOST_APART * span, loose))
    if apart > most:
        raise ProblemError(
            f"frame_rate_hz must be that of the times, {found:.9g} Hz; got {rate:.9g} Hz: "
            f"{apart:.3g} frames apart over the record. Leave it away, or leave the times away."
        )
    if apart > _SAID_FRAMES + loose:
        return [
            f"frame rate {rate:.9g} Hz, as stated; by the times {found:.9g} Hz, {apart:.3g} "
            "frames apart over the record"
        ]
    return []


def _check_rising(values: ArrayLike, name: str, rows: int) -> FloatArray:
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


def _frames_from_times(times: FloatArray, rate: float | None) -> tuple[IntArray, list[str]]:
    """Return the frame of each row, from 0, and notes.

    Rounded to a quantum q, the times of frames without a hole stay within ``q rate`` of a
    straight line; a missing frame leaves it by 1. Rows are laid on the grid where only one of
    the two explains them.
    """
    steps = np.diff(times)
    rising = steps[steps > 0]
    if rising.size == 0:
        raise ProblemError("times_s must rise; all rows have the same time.")
    period = float(np.median(rising)) if rate is None else 1 / rate
    _require_few_holes(float(times[-1] - times[0]) / period + 1, len(times))
    if rising.size == len(steps) and np.ptp(steps) < 2 * _CLEAR * float(np.median(steps)):
        # no frame is missing, whatever the rate is: that is compared afterwards
        return np.arange(len(times)), []
    quantum = _quantum(times, steps)
    if rate is None:
        return _lay_by_steps(times, steps, period, quantum), []
    return _lay_by_rate(times, steps, rate, quantum)


def _require_few_holes(frames: float, rows: int) -> None:
    """Refuse a record that would be nearly all holes."""
    if frames > (1 + _MOST_HOLES) * rows:
        raise ProblemError(
            f"{frames - rows:.15g} of {frames:.15g} frames would be missing between the first row "
            "and the last; cut the record where it was interrupted."
        )


def _quantum(times: FloatArray, steps: FloatArray) -> float:
    """Return the quantum of which all steps in time are multiples; 0 if there is none."""
    noise = 8 * float(np.spacing(np.max(np.abs(times))))
    levels = np.unique(steps)
    levels = np.concatenate([levels[:1], levels[1:][np.diff(levels) > noise]])
    gaps = np.concatenate([levels[levels > noise], np.diff(levels)])
    least = float(np.min(gaps[gaps > noise], initial=np.inf))
    if not np.isfinite(least):
        return 0.0
    counts = np.round(steps / least)
    if np.any(np.abs(steps / least - counts) > _WHOLE + noise / least) or not counts.sum():
        return 0.0
    return float(times[-1] - times[0]) / float(counts.sum())


def _grid_distance(times: FloatArray, rate: float) -> FloatArray:
    """Return how far complete rows are from a grid, (rows,) [frames]."""
    return np.asarray((times - times[0]) * rate - np.arange(len(times)))


def _closest_rate(times: FloatArray) -> tuple[float, float]:
    """Return the rate whose grid complete rows are closest to, and their spread [frames]."""
    rate = _fit_rate(times, np.arange(len(times)))
    ends = rate * (1 - 2 / len(times)), rate * (1 + 2 / len(times))
    for _ in range(_SEARCH):  # the spread is convex in the rate
        low, high = (ends[i] + (ends[1 - i] - ends[i]) / 3 for i in range(2))
        better = np.ptp(_grid_distance(times, low)) < np.ptp(_grid_distance(times, high))
        ends = (ends[0], high) if better else (low, ends[1])
    rate = sum(ends) / 2
    return rate, float(np.ptp(_grid_distance(times, rate)))


def _lay_by_steps(times: FloatArray, steps: FloatArray, period: float, quantum: float) -> IntArray:
    """Lay rows by the steps in time, for an unknown rate."""
    counts = np.round(steps / period)
    if np.any(np.abs(steps / period - counts) >= _CLEAR):
        k = int(np.argmax(np.abs(steps / period - counts)))
        raise ProblemError(
            f"times_s lie on no regular grid of {1 / period:.6g} Hz; row {k + 1} comes "
            f"{steps[k] / period:.3g} frames after the one before. Give frame_rate_hz, a counter "
            "of frames, or leave the times away."
        )
    if quantum > _COARSE * period and int(np.sum(counts != 1)) >= _FEW:
        rate, spread = _closest_rate(times)
        if spread <= quantum * rate + _WHOLE + _slack(times, rate):
            raise ProblemError(
                f"the steps in time, whole multiples of {quantum:.6g} s, are those of missing or "
                f"repeated frames at {1 / period:.6g} Hz, or of no such frame at {rate:.6g} Hz: "
                "the times may be rounded. Give frame_rate_hz."
            )
    return np.asarray(np.concatenate([[0], np.cumsum(counts)]), dtype=np.int64)


def _slack(times: FloatArray, rate: float) -> float:
    return 1e-6 + 16 * rate * float(np.spacing(np.max(np.abs(times))))


def _lay_by_rate(
    times: FloatArray, steps: FloatArray, rate: float, quantum: float
) -> tuple[IntArray, list[str]]:
    """Lay rows on the grid of a known rate."""
    rows, slack = len(times), _slack(times, rate)
    step = quantum * rate  # frames
    placed, gap, second = _part_in_widest_gap(times, steps, rate)
    coarse = step > _COARSE and abs(1 - step) * rows > _EXACT
    if coarse:
        complete = _is_complete(_grid_distance(times, rate), step, slack)
        if not complete and gap < _LEAST_GAP:  # a rate that is stated with few digits
            found, spread = _closest_rate(times)
            complete = abs(found / rate - 1) * rows < 0.5 and spread <= step + slack
        if complete:
            alone = step >= _ABOVE or placed is None or np.array_equal(placed, np.arange(rows))
            if alone and not _may_hide_frame(_grid_distance(times, rate), step, slack):
                return np.arange(rows), [f"times are rounded to {quantum:.6g} s"]
            raise ProblemError(
                f"times_s in steps of {quantum:.6g} s cannot tell rounding from missing or "
                f"repeated frames at {rate:.9g} Hz in {rows} rows. Give a counter of frames, or "
                "leave the times away."
            )
        # the frames begin in the gap that rounding leaves: another one that wide would do, too
        if placed is None or second >= 1 - step + _finest_distance(step) - slack:
            raise ProblemError(
                f"times_s in steps of {quantum:.6g} s leave the grid of {rate:.9g} Hz by up to "
                f"{np.ptp(_grid_distance(times, rate)):.3g} frames, and cannot tell which frames "
                "are missing or repeated. Give a counter of frames, or cut the record there."
            )
    if placed is not None:
        return placed, []
    return _lay_by_steps(times, steps, 1 / rate, 0.0), []


def _is_complete(apart: FloatArray, step: float, slack: float) -> bool:
    """Whether rounding alone explains how far the rows are from the grid."""
    spread = float(np.ptp(apart))
    if spread <= step - _finest_distance(step) + slack:
        return True
    # ties may be rounded up and down: then both ends are reached, and nothing moves
    if spread > step + slack or len(apart) < 4 * _BLOCKS:
        return False
    means = [float(block.mean()) for block in np.array_split(apart, _BLOCKS)]
    return max(means) - min(means) < 0.5


def _finest_distance(step: float) -> float:
    """Return the quantum of the distances from the grid; rounding reaches one end only."""
    part = Fraction(step).limit_denominator(_DENOMINATOR)
    return 1 / part.denominator if abs(float(part) - step) < 1e-9 else 0.0


def _may_hide_frame(apart: FloatArray, step: float, slack: float) -> bool:
    """Whether rounding may hide a missing frame, the ends of the record aside."""
    high, low = np.maximum.accumulate, np.minimum.accumulate
    top = np.maximum(high(apart)[:-1], high(apart[::-1])[::-1][1:] - 1)
    bottom = np.minimum(low(apart)[:-1], low(apart[::-1])[::-1][1:] - 1)
    end = 1 + len(apart) // _BLOCKS
    hidden = (top - bottom)[end:-end] <= step - _finest_distance(step) + slack
    return bool(hidden.any())


def _part_in_widest_gap(
    times: FloatArray, steps: FloatArray, rate: float
) -> tuple[IntArray | None, float, float]:
    """Return frames that begin in the widest gap (None if it is narrow), and the two widest."""
    grid = (times - times[0]) * rate
    parts = np.sort(grid - np.floor(grid))
    gaps = np.diff(np.append(parts, parts[0] + 1))
    k = int(np.argmax(gaps))
    gap = float(gaps[k])
    second = float(np.max(np.delete(gaps, k), initial=0.0))
    if gap < _LEAST_GAP:
        return None, gap, second
    frame = np.floor(grid - (parts[k] + gap / 2))
    if np.any(np.diff(frame)[steps > 0] <= 0):
        return None, gap, second
    return np.asarray(frame - frame[0], dtype=np.int64), gap, second


def _fit_rate(times: FloatArray, frame: IntArray) -> float:
    """Return the rate by a straight line through times and frames, to nine digits."""
    t, n = times - times.mean(), frame - frame.mean()
    slope = float(n @ t)
    if not slope > 0:
        raise ProblemError("times_s must rise; all rows have the same time.")
    return float(f"{float(n @ n) / slope:.9g}")
