"""Records from arrays: converted to nm, laid on a regular grid and searched for faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records import faults
from lbt_synth.identification.records.clock import build_clock
from lbt_synth.identification.records.columns import nm_unit, unit_to_show
from lbt_synth.identification.records.faults import Finding, findings_in
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models import PositionLoop
from lbt_synth.validation import BoolArray, FloatArray, IntArray, float_array

_LARGEST_NM = 1e30  # a larger number is a filler
TREND = 2.0  # ratio of scatters

# what spoils a measurement; a command is spoilt by the first alone
_FINDERS = (
    ("saturated", faults.find_saturated),
    ("stuck", faults.find_stuck),
    ("outlier", faults.find_outliers),
)


def loop_record(
    measurements: ArrayLike,
    commands: ArrayLike | None = None,
    *,
    frame_rate_hz: float | None = None,
    unit: str,
    delay_frames: float | None = None,
    mirror: PositionLoop | None = None,
    times_s: ArrayLike | None = None,
    frame_numbers: ArrayLike | None = None,
    command_unit: str | None = None,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    source: str = "arrays",
    notes: Sequence[str] = (),
) -> LoopRecord:
    """Make a record of series, and find its faults.

    Parameters
    ----------
    measurements : (frames, axes) or (frames,) array_like
        Measurements y(k) of one or two axes; the pseudo-open-loop series, without commands.
        NaN and infinities are gaps.
    commands : (frames, axes) or (frames,) array_like, optional
        Commands u(k), computed from the measurements up to y(k).
    frame_rate_hz : float, optional
        Frame rate [Hz]; that of ``times_s`` by default.
    unit : str
        Unit of the measurements: nm, um or m rms of wavefront, or mas, arcsec, urad or rad of
        tilt, for which the diameter is needed.
    delay_frames : float, optional
        Total delay [frames], from the middle of an exposure to that of its command.
    mirror : PositionLoop, optional
        Dynamics of the mirror; one that settles at once by default.
    times_s : (frames,) array_like, optional
        Time of each row [s]; missing frames become holes.
    frame_numbers : (frames,) array_like, optional
        Counter of frames of each row; missing frames become holes.
    command_unit : str, optional
        Unit of the commands; that of the measurements by default.
    diameter_m, obstruction : float, optional
        Telescope diameter [m], and its central obstruction as a fraction of it.
    source : str, optional
        Where it is from.
    notes : sequence of str, optional
        What is to be noted of it.

    Returns
    -------
    LoopRecord
        Series in nm on the regular grid, and the faults that were found.

    Raises
    ------
    ProblemError
        If sizes clash, the rate is not known or is contradicted, times run backwards, a unit is
        unknown, or a value is out of range.

    Notes
    -----
    A frame is spoilt where a measurement is missing, not finite, held, at an end of the range that
    is reached repeatedly, or outlying. A command that is missing, not finite or at a limit spoils
    the frames whose correction it is part of. A note says where the scatter changes. The page on
    records has the thresholds.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> y = np.random.default_rng(0).standard_normal((1000, 2))
    >>> y[400, 0] = 80.0
    >>> seen = lbt.identification.loop_record(y, frame_rate_hz=1000, unit="mas", diameter_m=8.22)
    >>> seen.summary()
    '999 of 1000 frames are usable; 1 outlier (measurements).'
    >>> round(float(seen.measurements[0, 0] / y[0, 0]), 3)
    9.963
    """
    y = _series_in_nm(measurements, "measurements", nm_unit(unit, diameter_m=diameter_m).factor)
    u = None
    if commands is not None:
        scale = nm_unit(command_unit or unit, diameter_m=diameter_m, name="command_unit")
        u = _series_in_nm(commands, "commands", scale.factor)
        if u.shape != y.shape:
            raise DimensionError(f"commands must match measurements {y.shape}; got {u.shape}.")
    clock = build_clock(
        len(y), frame_rate_hz=frame_rate_hz, times_s=times_s, frame_numbers=frame_numbers
    )
    findings, said = list[Finding](), [*notes, *clock.notes]
    rows = y if u is None else np.hstack([y, u])
    rows, there = _lay_on_grid(rows, clock.frame_of_row, findings, said)
    axes, frames = y.shape[1], len(rows)
    y, measured = _judge_series(rows[:, :axes], there, "measurements", findings)
    commanded = np.ones(frames, dtype=np.bool_)
    if u is not None:
        u, commanded = _judge_series(rows[:, axes:], there, "commands", findings)
    said += _note_trends(y, measured)
    return LoopRecord(
        frame_rate_hz=clock.frame_rate_hz,
        measurements=y,
        commands=u,
        delay_frames=delay_frames,
        mirror=mirror,
        measured=measured,
        commanded=commanded,
        faults=tuple(findings),
        notes=tuple(dict.fromkeys(said)),
        diameter_m=diameter_m,
        obstruction=obstruction,
        shown_unit=unit_to_show(unit),
        source=source,
    )


def _series_in_nm(value: Any, name: str, scale: float) -> FloatArray:
    """Return a series as (frames, axes) in nm, NaN where it is masked, not finite or absurd."""
    out = float_array(value, name)
    if out.ndim == 1:
        out = out[:, None]
    if out.ndim != 2 or out.size == 0:
        raise DimensionError(f"{name} must be (frames, axes) and not empty; got {out.shape}.")
    if out.shape[1] > 2:
        turn = " Transpose it." if out.shape[0] <= 2 else " Choose tip and tilt."
        raise DimensionError(f"{name} must have one or two axes; got {out.shape}.{turn}")
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = scale * out
        return np.where(np.abs(scaled) < _LARGEST_NM, scaled, np.nan)


def _lay_on_grid(
    rows: FloatArray, frame: IntArray, findings: list[Finding], said: list[str]
) -> tuple[FloatArray, BoolArray]:
    """Return the first row of each frame, NaN without one, and the frames whose rows agree."""
    is_first = np.diff(frame, prepend=-1) > 0
    first = np.flatnonzero(is_first)
    earlier = rows[first[np.cumsum(is_first) - 1]]
    differs = ~np.all((rows == earlier) | (np.isnan(rows) & np.isnan(earlier)), axis=1)
    there, torn = np.zeros((2, frame[-1] + 1), dtype=np.bool_)
    there[frame], torn[frame[differs]] = True, True
    findings += findings_in(~there, "missing", "frames")
    findings += findings_in(torn, "repeated", "frames")
    if again := len(rows) - len(first):
        said.append(f"{again} rows of a time that had been recorded already were left out")
    out = np.full((len(there), rows.shape[1]), np.nan)
    out[frame[first]] = rows[first]
    return out, there & ~torn


def _judge_series(
    series: FloatArray, there: BoolArray, name: str, findings: list[Finding]
) -> tuple[FloatArray, BoolArray]:
    """Return the series with faults filled, and the frames that are good on all axes."""
    out, all_good = np.empty(series.shape), np.ones(len(series), dtype=np.bool_)
    for axis, column in enumerate(series.T):
        good = there & np.isfinite(column)
        findings += findings_in(there & ~good, "not finite", name, axis)
        for kind, finder in _FINDERS[: 1 if name == "commands" else None]:
            faulty = finder(np.where(np.isfinite(column), column, 0.0), good)
            findings += findings_in(faulty, kind, name, axis)
            good &= ~faulty
        out[:, axis] = faults.fill(column, good)
        all_good &= good
    return out, all_good


def _note_trends(series: FloatArray, good: BoolArray) -> Iterator[str]:
    """Note where the scatter from frame to frame changes between the ends of the record."""
    for axis, column in enumerate(series.T):
        first, last = end_scatters(column, good)
        if max(first, last) > TREND * min(first, last):
            calm, rough = ("first", "last") if first < last else ("last", "first")
            percent = 100 * min(first, last) / max(first, last)
            yield (
                f"axis {axis} is not stationary: the rms difference of two frames in the {calm} "
                f"quarter is {percent:.0f} % of that in the {rough}"
            )


def end_scatters(series: FloatArray, good: BoolArray) -> tuple[float, float]:
    """Return the rms difference of two good frames in the first and last quarter, nan of few."""
    steps = np.diff(series)[good[1:] & good[:-1]]
    quarter = steps.size // 4
    if quarter < SHORTEST_SEGMENT:
        return float("nan"), float("nan")
    first, last = (np.sqrt(np.mean(ends**2)) for ends in (steps[:quarter], steps[-quarter:]))
    return float(first), float(last)
