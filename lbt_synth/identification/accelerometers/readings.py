"""Readings of accelerometers: from a file, averaged over the frames of a loop.

Units of accelerations.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from lbt_synth.errors import DimensionError, ProblemError, TelemetryError
from lbt_synth.identification.records.clock import build_clock
from lbt_synth.identification.records.columns import Column, clock_factor
from lbt_synth.identification.records.contents import CLOCKS, Contents, read_contents
from lbt_synth.identification.records.faults import fill, find_outliers, find_stuck, mark, runs
from lbt_synth.identification.records.record import BRIDGED_FRAMES, LoopRecord
from lbt_synth.models import LoopHardware
from lbt_synth.models.sensor_suite import Accelerometer, SensorSuite
from lbt_synth.storage.display_unit import M_S2
from lbt_synth.validation import BoolArray, FloatArray, float_array, number

LEAST_M_S2 = 1e-9  # rms, a thousandth of what a quiet accelerometer resolves
_MISSING = 0.1  # of the frames without a number, from which a channel counts as dead
_NAME = re.compile(r"\w[\w .+-]*$")
_SPELLINGS = re.compile(r"\s*/\s*s(\^|\*\*)?2$|\s*/\s*s²$|[ .*]s(\^|\*\*)?-2$")

Readings = tuple[tuple[str, ...], FloatArray, tuple[str, ...]]  # channels, values, notes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Accelerometers beside a record, in its frames: what the computer of the loop reads in each.

    The reading of a row is there when the measurement of this row is. Its age in a loop is taken to
    be that of the measurement, a frame, whatever lies between the clocks.
    """

    names: tuple[str, ...]  # of the channels that live
    dead: tuple[str, ...]  # names of the others
    values: FloatArray  # (frames, c): readings, zero where one is missing [m/s^2]
    good: BoolArray  # (frames,): whether all channels that live have a reading

    def hardware(self, path: LoopHardware) -> LoopHardware:
        """Return a loop that reads the channels, with the noise of each reading.

        That is at most what their change from frame to frame does not share with the next one.
        """
        lively = self.values[self.good]
        steps = np.diff(lively, n=2, axis=0)
        noise = np.maximum(np.sqrt(np.median(steps**2, axis=0) / 6), LEAST_M_S2)
        sensor = Accelerometer(
            name="accelerometers",
            rate_hz=path.frame_rate_hz,
            delay_frames=path.delay_frames,
            channels=self.names,
            noise_m_s2=noise,
        )
        return replace(path, suite=SensorSuite(sensors=(sensor,)))


def read_channels(accelerations: ArrayLike, names: Sequence[str] | None = None) -> Channels:
    """Return the channels of readings (frames, c) [m/s^2] that live, NaN where one is missing.

    Held values and spikes are missing, too; gaps of a few frames are bridged. A channel that misses
    more than a tenth of the frames that any channel has, or does not move, is dead and spoils none.
    """
    readings = float_array(accelerations, "accelerations")
    readings = readings[:, None] if readings.ndim == 1 else readings
    if readings.ndim != 2 or readings.size == 0:
        raise DimensionError(f"accelerations must be (frames, channels); got {readings.shape}.")
    count = readings.shape[1]
    called = tuple(names or (f"channel{c + 1}" for c in range(count)))
    if len(called) != count or len(set(called)) < count:
        raise ProblemError(
            f"channels must be {count} different names, one per column; got {', '.join(called)}."
        )
    good, filled = np.isfinite(readings), np.zeros(readings.shape)
    recorded = np.sum(good.any(axis=1))
    for c, series in enumerate(readings.T):
        held = find_stuck(series, good[:, c])
        good[:, c] &= ~held & ~find_outliers(series, good[:, c] & ~held)
        filled[:, c] = fill(series, good[:, c])
        gaps = runs(~good[:, c])
        good[:, c] |= mark(gaps[gaps[:, 1] - gaps[:, 0] <= BRIDGED_FRAMES], len(series))
    fine = np.sum(good, axis=0) >= (1 - _MISSING) * recorded
    usable = np.asarray(good[:, fine].all(axis=1))
    moves = np.std(filled[usable], axis=0) > LEAST_M_S2 if usable.any() else np.zeros(count, bool)
    live = fine & moves
    return Channels(
        names=tuple(name for name, lives in zip(called, live, strict=True) if lives),
        dead=tuple(name for name, lives in zip(called, live, strict=True) if not lives),
        values=np.where(good, filled, 0.0)[:, live],
        good=usable,
    )


def channels_beside(
    record: LoopRecord, accelerations: ArrayLike, names: Sequence[str] | None = None
) -> Channels:
    """Return the channels that live in the frames of a record; what comes after is not read."""
    read = read_channels(accelerations, names)
    if not read.names:
        raise ProblemError(
            f"accelerometers must move; got nothing but zeros or gaps in {', '.join(read.dead)}. "
            "Leave them out."
        )
    frames = min(record.frames, len(read.good))
    values, good = np.zeros((record.frames, len(read.names))), np.zeros(record.frames, bool)
    values[:frames], good[:frames] = read.values[:frames], read.good[:frames]
    return replace(read, values=values, good=good)


def load_readings(
    path: str | os.PathLike[str],
    frame_rate_hz: float,
    *,
    rate_hz: float | None = None,
    unit: str | None = None,
) -> Readings:
    """Read accelerations from a file of any format that records have, one column per channel.

    Return the names of the channels, their values (frames, channels) [m/s^2], NaN where one is
    missing, and notes. Their rate is that of their times or of the header, if it is not given. At
    another rate than the loop's they are laid on its frames.
    """
    source = Path(path)
    contents = read_contents(source)
    columns = [column for column in contents.columns if column.role not in CLOCKS]
    sizes = sorted({column.values.size for column in contents.columns})
    if not columns or len(sizes) != 1:
        raise TelemetryError(
            f"{source} must hold columns of one length, a sensor each; got {len(columns)} of "
            f"{sizes} rows.",
            path=source,
        )
    names = [column.name.strip() for column in columns]
    if not all(_NAME.match(name) for name in names) or len(set(names)) < len(names):
        names = [f"channel{c + 1}" for c in range(len(columns))]
    values = np.stack([_m_s2(column, unit, source) * column.values for column in columns], axis=1)
    values, own_hz, notes = _on_own_clock(contents, values, rate_hz, frame_rate_hz)
    if own_hz != frame_rate_hz:
        values = resample(values, own_hz, frame_rate_hz)
    shifted = [name for name, series in zip(names, values.T, strict=True) if _is_offset(series)]
    if shifted:
        notes.append(
            f"readings of {', '.join(shifted)} have an offset, which a filter takes for motion: "
            "subtract it before they reach the loop"
        )
    return tuple(names), values, tuple(notes)


def _is_offset(series: FloatArray) -> bool:
    """Whether the mean of readings is more than what they move by."""
    good = series[np.isfinite(series)]
    return bool(good.size and abs(good.mean()) > good.std() > 0)


def _m_s2(column: Column, unit: str | None, source: Path) -> float:
    """Return the m/s^2 of one unit of a column: as given, as its heading says, or one."""
    heading = _SPELLINGS.sub("/s2", (column.unit or "").strip()).replace("µ", "u").lower()
    factor = M_S2.get(heading or "m/s2") if unit is None else M_S2[unit]
    if factor is None or M_S2.get(heading, factor) != factor:
        raise TelemetryError(
            f"accelerations must be in one of {', '.join(M_S2)}; {column.name} of {source} is in "
            f"{column.unit!r}, and acceleration_unit says {unit}. Scale them, or correct which is "
            "wrong.",
            path=source,
        )
    return factor


def _on_own_clock(
    contents: Contents, values: FloatArray, rate_hz: float | None, frame_rate_hz: float
) -> tuple[FloatArray, float, list[str]]:
    """Return readings without jumps in time, NaN where rows are missing, and their rate."""
    own_hz = contents.find_fact("frame_rate_hz", rate_hz)
    if own_hz is not None:
        own_hz = number(own_hz, "accelerometer_rate_hz", above=0)
    clocks = {column.role: column for column in contents.columns if column.role in CLOCKS}
    times, counter = clocks.get("times"), clocks.get("frame_numbers")
    if times is None and counter is None:
        note = "no rate is given for the accelerometers: that of the loop is taken"
        return values, own_hz or frame_rate_hz, [] if own_hz else [note]
    clock = build_clock(
        len(values),
        frame_rate_hz=own_hz or (frame_rate_hz if times is None else None),
        times_s=None if times is None else times.values * clock_factor(times.unit, "s"),
        frame_numbers=None if counter is None else counter.values,
    )
    laid = np.full((int(clock.frame_of_row[-1]) + 1, values.shape[1]), np.nan)
    laid[clock.frame_of_row] = values
    return laid, clock.frame_rate_hz, [f"accelerometers: {note}" for note in clock.notes]


def resample(values: FloatArray, rate_hz: float, frame_rate_hz: float) -> FloatArray:
    """Return readings (n, channels) averaged over the frames of a loop, NaN beside missing ones.

    A reading is the mean over its period: their sum has a cubic spline through the ends of the
    periods, whose differences are the means over frames.
    """
    ratio = rate_hz / frame_rate_hz
    frames = int(len(values) / ratio)
    if round(ratio, 6) < 1 or frames < 1:
        raise ProblemError(
            f"accelerations must come at least once a frame, {frame_rate_hz:g} Hz, and last a "
            f"frame; got {len(values)} readings at {rate_hz:g} Hz. Is the rate right? If so, "
            "record them faster; else give accelerometer_rate_hz."
        )
    edges, places = np.arange(len(values) + 1), np.arange(frames + 1) * ratio
    first = np.floor(places[:-1]).astype(int)
    last = np.minimum(np.ceil(places[1:]).astype(int), len(values))
    out = np.full((frames, values.shape[1]), np.nan)
    for c, series in enumerate(values.T):
        good = np.isfinite(series)
        if good.any():
            mean = float(np.mean(series[good]))
            total = np.append(0.0, np.cumsum(fill(series, good) - mean))
            gone = np.append(0, np.cumsum(~good))
            means = np.diff(CubicSpline(edges, total)(places)) / ratio + mean
            out[:, c] = np.where(gone[last] == gone[first], means, np.nan)
    return out
