"""The clock of a record: its rows on a regular grid, by times or frame counters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.records.frame_grid import (
    fit_rate,
    frames_from_times,
    require_few_holes,
)
from lbt_synth.validation import FloatArray, IntArray, number, real_array

_MOST_APART = 5e-3  # by which a stated rate may differ from that of the times at all
_SAME_RATE = 1e-4  # by which it may differ in a record of any length
_SAME_FRAMES = 3.0  # by which it may differ over the record, if that is more
_SAID_FRAMES = 0.5  # over the record, beyond which a difference is noted
_MOST_UNEVEN = 0.1  # of the steps, longer than a frame, if the times give the rate
_FEW_ROWS = 20  # too few for that share


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Clock:
    """Where each row of a record lies."""

    frame_rate_hz: float
    frame_of_row: IntArray  # (rows,), from 0, never falling; equal for rows of the same time
    frames: int  # from the first row to the last
    notes: tuple[str, ...] = ()


def build_clock(
    rows: int,
    *,
    frame_rate_hz: float | None,
    times_s: FloatArray | None = None,
    frame_numbers: FloatArray | None = None,
) -> Clock:
    """Lay rows on a regular grid, by their times (rows,) or frame numbers (rows,)."""
    rate = None if frame_rate_hz is None else number(frame_rate_hz, "frame_rate_hz", above=0)
    notes: list[str] = []
    frame = np.arange(rows)
    times = None if times_s is None else _check_rising(times_s, "times_s", rows)
    if frame_numbers is not None:
        frame = _frames_from_counter(_check_rising(frame_numbers, "frame_numbers", rows))
    if times is not None and rows > 1:
        if frame_numbers is None:
            frame, notes = frames_from_times(times, rate)
        found = fit_rate(times, frame)
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
    frames = int(frame[-1]) + 1
    require_few_holes(frames, rows)
    return Clock(frame_rate_hz=rate, frame_of_row=frame, frames=frames, notes=tuple(notes))


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


def _check_rising(values: FloatArray, name: str, rows: int) -> FloatArray:
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
    require_few_holes(float(numbers[-1]) - float(numbers[0]) + 1, len(numbers))
    return np.asarray(numbers - numbers[0], dtype=np.int64)
