"""Records from named series, whose commands may be in a second file.

Records from arrays, converted to nm, laid on a regular grid and searched for faults.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError, TelemetryError
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records import faults
from lbt_synth.identification.records.clock import build_clock
from lbt_synth.identification.records.columns import (
    VOLTS,
    Column,
    density_unit,
    hz_per,
    is_angle,
    nm_per,
    same_unit,
    seconds_per,
)
from lbt_synth.identification.records.contents import (
    CLOCKS,
    Contents,
    Roles,
    join_names,
    number_axes,
)
from lbt_synth.identification.records.faults import Finding, RecordHealth, findings_in, merge_notes
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import BoolArray, FloatArray, IntArray, float_array, number

_RATES_HZ = (5.0, 1e5)  # plausible for times without a unit
_FACTS = {
    "loop": ("frame_rate_hz", "diameter_m", "delay_frames", "obstruction"),
    "spectrum": ("frame_rate_hz", "diameter_m", "averages"),
}
_UNITS = {
    "loop": "nm, um, m of wavefront, or mas, arcsec, urad, rad of tilt",
    "spectrum": "nm^2/Hz, or mas^2/Hz of tilt; nm/sqrt(Hz) of an amplitude",
}
_LARGEST_NM = 1e30  # a larger number is a filler
_OPEN_FRAMES = 20  # of zero or equal commands
TREND = 2.0  # ratio of scatters

Finders = tuple[tuple[str, Callable[[FloatArray, BoolArray], BoolArray]], ...]


def build_record(
    kind: str,
    columns: Roles,
    contents: Contents,
    *,
    unit: str | None,
    command_unit: str | None,
    mirror: PositionLoop | None,
    source: str,
    **given: Any,
) -> LoopRecord | SpectrumRecord:
    """Make a record; ``given`` are the facts of the call, None where the source has to tell."""
    role, is_loop = next(iter(columns)), kind != "spectrum"
    if is_loop and given.pop("averages", None) is not None:
        raise ProblemError(f"averages are only for a spectrum; the record is of kind {kind}.")
    kind = "loop" if is_loop else kind
    facts = {name: _find_fact(contents, name, given[name]) for name in _FACTS[kind]}
    if is_loop:
        units = {role: unit, "commands": command_unit or unit}
        _require_facts(columns, contents, units, facts)
    own_unit = _find_unit(columns[role], unit, contents, kind)
    if not is_loop:
        return _build_spectrum(columns, contents, own_unit, source=source, **facts)
    u, u_unit = columns.get("commands"), None
    if u is not None:
        u_unit = _find_unit(u, command_unit, contents, kind, "command_unit", default=unit)
    (clock,) = columns.get("times", [None])
    (counter,) = columns.get("frame_numbers", [None])
    times = None if clock is None else seconds_per(clock.unit) * clock.values
    if clock is not None and not clock.unit:
        contents.notes.append(f"{clock.name} was taken for seconds")
    record = loop_record(
        _stack_columns(columns[role]),
        None if u is None else _stack_columns(u),
        unit=own_unit,
        command_unit=u_unit,
        mirror=mirror,
        times_s=times,
        frame_numbers=None if counter is None else counter.values,
        notes=contents.notes,
        source=source,
        **facts,
    )
    low, high = _RATES_HZ
    plausible = facts["frame_rate_hz"] is not None or low <= record.frame_rate_hz <= high
    if clock is not None and not clock.unit and not plausible:
        raise ProblemError(
            f"the frame rate would be {record.frame_rate_hz:.6g} Hz with "
            f"{clock.name or 'the times'} in seconds, and their unit is not given; name it, as in "
            "time_ms, or give frame_rate_hz."
        )
    return record


def _require_facts(
    columns: Roles, contents: Contents, units: Mapping[str, str | None], facts: Mapping[str, Any]
) -> None:
    """Refuse a loop of which several facts are missing, all of them in one message."""
    of_file = "".join(map(str, contents.facts.get("unit", {}).values()))
    units_of_columns = [
        (column, column.unit or of_file or unit or "")
        for role, unit in units.items()
        for column in columns.get(role, ())
    ]
    bare = [column for column, unit in units_of_columns if not unit]
    angles = facts["diameter_m"] is None and any(is_angle(unit) for _, unit in units_of_columns)
    no_rate = facts["frame_rate_hz"] is None and "times" not in columns
    no_delay = facts["delay_frames"] is None and "commands" in columns
    checks = (
        (bare, f"the unit of {join_names(bare)}: give unit ({_UNITS['loop']})"),
        (angles, "the telescope, by which angles become nm: give diameter_m"),
        (no_rate, "the frame rate: give frame_rate_hz, or the times"),
        (no_delay, "the total delay: give delay_frames"),
    )
    missing = [text for lacks, text in checks if lacks]
    if len(missing) > 1:
        raise ProblemError(f"nothing tells {'; '.join(missing)}.")


def _find_fact(contents: Contents, name: str, given: Any) -> Any:
    """Return what was given, or what the source has; refuse two values of a source."""
    places = contents.facts.get(name, {})
    values = {where: number(value, f"{where} ({name})") for where, value in places.items()}
    if given is None:
        if len(set(values.values())) > 1:
            listing = ", ".join(f"{value:.9g} by {where}" for where, value in values.items())
            raise ProblemError(f"the file gives {name} twice: {listing}. Choose one in the call.")
        for where, value in values.items():
            contents.notes.append(f"{name} {value:.9g}, by {where}")
            return int(value) if name == "averages" else value
        return None
    wanted = number(given, name)
    for where, value in values.items():
        if abs(value - wanted) > 1e-6 * wanted:
            if name == "frame_rate_hz":
                raise ProblemError(
                    f"{name} must be that of {where}, {value:.9g}; got {wanted:.9g}."
                )
            contents.notes.append(f"{name} {wanted:.9g} was given; {where} has {value:.9g}")
    return given


def _find_unit(
    chosen: Sequence[Column],
    stated: str | None,
    contents: Contents,
    kind: str,
    option: str = "unit",
    default: str | None = None,
) -> str:
    """Return the unit of some columns by their names or headers, the source, or the call."""
    facts = contents.facts.get(option, contents.facts.get("unit", {}))
    of_file = list(dict.fromkeys(map(str, facts.values())))
    units = {column.unit or (of_file[0] if of_file else "") for column in chosen}
    if len(units) > 1 or len(of_file) > 1:
        raise ProblemError(
            f"{join_names(chosen)} must all have the same unit; got "
            f"{', '.join(sorted(units.union(of_file)))}."
        )
    (unit,) = units
    if unit and stated is not None and not same_unit(unit, stated):
        raise ProblemError(
            f"{option} must be that of the data, {unit!r}; got {stated!r}.",
            at_terminal="Leave it out; --show-unit is the unit of what is shown.",
        )
    unit = unit or stated or default or ""
    if not unit:
        raise ProblemError(
            f"nothing tells the unit of {join_names(chosen)}; give {option} ({_UNITS[kind]}).",
            **(VOLTS if option == "command_unit" else {}),
        )
    return str(unit)


def _stack_columns(chosen: Sequence[Column]) -> FloatArray:
    sizes = {len(column.values) for column in chosen}
    if len(sizes) > 1:
        raise ProblemError(
            f"{' and '.join(column.name for column in chosen)} must be equally long; got "
            f"{' and '.join(map(str, sorted(sizes)))} rows."
        )
    return np.column_stack([column.values for column in chosen])


def _build_spectrum(
    columns: Roles, contents: Contents, unit: str, *, diameter_m: float | None, **facts: Any
) -> SpectrumRecord:
    role, densities = next(iter(columns.items()))
    (frequency,) = columns["frequency"]
    parted = density_unit(unit)
    if parted is None:
        raise ProblemError(
            f"the unit of a density is a square over Hz (nm^2/Hz, mas^2/Hz), or a length or angle "
            f"over sqrt(Hz) (nm/sqrt(Hz)); got {unit!r}."
        )
    name, power = parted
    if role == "amplitude" and power == 2:
        raise ProblemError(
            f"{densities[0].name} is named as an amplitude, but has the unit {unit!r} of a power; "
            "choose by columns={'density': ...}."
        )
    if not frequency.unit:
        contents.notes.append("frequencies were taken for Hz")
    table = _stack_columns([frequency, *densities])
    complete = np.all(np.isfinite(table), axis=1)
    if not complete.all():
        contents.notes.append(f"{int(np.sum(~complete))} rows with gaps were left out")
    table = table[complete]
    scaled = nm_per(name, diameter_m=diameter_m) ** power * table[:, 1:]
    if power == 1:
        if np.any(scaled < 0):
            raise ProblemError("an amplitude density must be at least 0; got a negative one.")
        contents.notes.append("amplitude densities were squared")
        scaled = scaled**2
    return SpectrumRecord(
        frequency_hz=hz_per(frequency.unit) * table[:, 0],
        density_nm2_hz=scaled,
        diameter_m=diameter_m,
        notes=merge_notes(contents.notes),
        **facts,
    )


_SAME_TIME = 0.25  # of a step, within which two rows are of one frame


def join_commands(contents: Contents, other: Contents, path: Path) -> None:
    """Add the commands of another file, in place of those of the first.

    Rows are matched by the counters of both files, or else by the times of both (within a
    quarter of a step). Without a common clock both files must have equally many rows.
    """
    named = [column for column in other.columns if column.role == "commands"] or [
        column for column in other.columns if column.role in (None, "measurements")
    ]
    if not named:
        raise TelemetryError(f"{path} holds no commands.", path=path)
    named = _match_commands(contents, other, named, path)
    if len(named) > 1 and any(column.axis is None for column in named):
        named = number_axes(named)
    columns = [column for column in contents.columns if column.role != "commands"]
    if not any(column.role in ("measurements", "open_loop") for column in columns):
        plain = number_axes([column for column in columns if column.role is None])
        columns = [column for column in columns if column.role is not None]
        columns += [replace(column, role="measurements") for column in plain]
    contents.columns = columns + [replace(column, role="commands") for column in named]
    for fact, places in other.facts.items():
        if fact != "unit":
            for where, value in places.items():
                contents.facts.setdefault(fact, {})[f"{where} in {path.name}"] = value
    # a unit is that of its own file
    contents.facts["command_unit"] = dict(other.facts.get("unit", {}))
    contents.notes += [f"commands are from {path}", *other.notes]


def _match_commands(
    contents: Contents, other: Contents, commands: list[Column], path: Path
) -> list[Column]:
    """Return the commands in the rows of the measurements, NaN where there are none."""
    counts = [{len(each.values) for each in columns} for columns in (contents.columns, commands)]
    for role in CLOCKS:
        clocks = [c for file in (contents, other) for c in file.columns if c.role == role]
        if len(clocks) != 2 or [{len(clock.values)} for clock in clocks] != counts:
            continue
        in_s = [seconds_per(clock.unit) if role == "times" else 1.0 for clock in clocks]
        at = _match_rows(in_s[0] * clocks[0].values, in_s[1] * clocks[1].values, role, path)
        there = at >= 0
        if not np.array_equal(at, np.arange(len(clocks[1].values))):
            contents.notes.append(
                f"commands were laid beside the measurements by {clocks[1].name}: "
                f"{int(np.sum(there))} of {len(at)} rows have one"
            )
        return [replace(each, values=np.where(there, each.values[at], np.nan)) for each in commands]
    rows = sorted(set.union(*counts))
    if len(rows) > 1:
        raise TelemetryError(
            f"{path} must have as many frames as the measurements; got "
            f"{', '.join(map(str, rows))}. Or give both files a counter of frames, or times.",
            path=path,
        )
    if any(each.role in CLOCKS for each in (*contents.columns, *other.columns)):
        contents.notes.append(
            "the files have no clock in common: rows of the same number were taken for one frame"
        )
    return commands


def _match_rows(one: FloatArray, other: FloatArray, role: str, path: Path) -> IntArray:
    """Return the row of the second clock for each row of the first, -1 where there is none."""
    steps = [np.diff(clock) for clock in (one, other)]
    if not all(np.all(step >= 0) for step in steps):  # no gap does
        raise TelemetryError(f"the {role} of both files must rise, without gaps.", path=path)
    if np.array_equal(one, other):
        return np.arange(len(one))
    if np.any(steps[1] == 0):
        raise TelemetryError(
            f"the {role} of {path} must rise from row to row to be matched with those of the "
            "measurements; got two rows alike.",
            path=path,
        )
    within = _SAME_TIME if role == "times" else 0.0
    tolerance = within * min(float(np.median(step)) for step in steps)
    at = np.searchsorted((other[1:] + other[:-1]) / 2, one, side="right")
    at = np.where(np.abs(other[at] - one) <= tolerance, at, -1)
    if np.mean(at >= 0) < 0.5:
        raise TelemetryError(
            f"only {int(np.sum(at >= 0))} of {len(one)} measurements have a command in {path} by "
            f"their {role}; they go from {one[0]:.12g} to {one[-1]:.12g} and from {other[0]:.12g} "
            f"to {other[-1]:.12g}. Give files of the same frames, or leave the {role} away in one "
            "of them if the rows do belong together.",
            path=path,
        )
    return at


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
        Notes for its ``health``.

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
    the frames whose correction it is part of. Commands that are zero or held, and a scatter that
    changes, are reported only. The page on records has the thresholds.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> y = np.random.default_rng(0).standard_normal((1000, 2))
    >>> y[400, 0] = 80.0
    >>> seen = lbt.identification.loop_record(y, frame_rate_hz=1000, unit="mas", diameter_m=8.22)
    >>> seen.health.summary()
    '999 of 1000 frames are usable; 1 outlier (measurements).'
    >>> round(float(seen.measurements[0, 0] / y[0, 0]), 3)
    9.963
    """
    scale = nm_per(unit, diameter_m=diameter_m)
    y, u = _series_in_nm(measurements, "measurements", scale), None
    if commands is not None:
        unit_of_commands = unit if command_unit is None else command_unit
        scale = nm_per(unit_of_commands, diameter_m=diameter_m, name="command_unit")
        u = _series_in_nm(commands, "commands", scale)
        if u.shape != y.shape:
            raise DimensionError(f"commands must match measurements {y.shape}; got {u.shape}.")
    clock = build_clock(
        len(y), frame_rate_hz=frame_rate_hz, times_s=times_s, frame_numbers=frame_numbers
    )
    findings, said = list[Finding](), [*notes, *clock.notes]
    rows = y if u is None else np.hstack([y, u])
    rows, there = _lay_on_grid(rows, clock.frame_of_row, findings, said)
    axes, frames = y.shape[1], len(rows)
    y, measured = _judge_series(rows[:, :axes], there, "measurements", _MEASURED, findings)
    commanded = np.ones(frames, dtype=np.bool_)
    if u is not None:
        u, commanded = _judge_series(rows[:, axes:], there, "commands", _COMMANDED, findings)
        findings += _held_commands(u, commanded)
    said += _note_trends(y, measured)
    record = LoopRecord(
        frame_rate_hz=clock.frame_rate_hz,
        measurements=y,
        commands=u,
        delay_frames=delay_frames,
        mirror=mirror,
        usable=measured,
        health=RecordHealth(
            frames=frames,
            usable=int(np.sum(measured)),
            findings=tuple(findings),
            notes=merge_notes(said),
            jitter_frames=clock.jitter_frames,
        ),
        diameter_m=diameter_m,
        obstruction=obstruction,
        source=source,
        measured=measured,
        commanded=commanded,
    )
    return record if record.delay_frames is None else record.with_delay(record.delay_frames)


def _series_in_nm(value: Any, name: str, scale: float) -> FloatArray:
    """Return a series as (frames, axes) in nm, NaN where it is masked, not finite or absurd."""
    if isinstance(value, np.ma.MaskedArray) and value.dtype.kind in "fiub":
        value = np.ma.filled(value.astype(np.float64), np.nan)
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
    series: FloatArray, there: BoolArray, name: str, finders: Finders, findings: list[Finding]
) -> tuple[FloatArray, BoolArray]:
    """Return the series with faults filled, and the frames that are good on all axes."""
    out, all_good = np.empty(series.shape), np.ones(len(series), dtype=np.bool_)
    for axis, column in enumerate(series.T):
        good = there & np.isfinite(column)
        findings += findings_in(there & ~good, "not finite", name, axis)
        for kind, finder in finders:
            faulty = finder(np.where(np.isfinite(column), column, 0.0), good)
            findings += findings_in(faulty, kind, name, axis)
            good &= ~faulty
        out[:, axis] = faults.fill(column, good)
        all_good &= good
    return out, all_good


def _find_clipped(series: FloatArray, good: BoolArray) -> BoolArray:
    """Find commands at a limit; zeros are those of an open loop."""
    return faults.find_saturated(series, good & (series != 0))


_MEASURED: Finders = (
    ("saturated", faults.find_saturated),
    ("stuck", faults.find_stuck),
    ("outlier", faults.find_outliers),
)
_COMMANDED: Finders = (("saturated", _find_clipped),)


def _held_commands(commands: FloatArray, good: BoolArray) -> Iterator[Finding]:
    """Yield where the loop was open, and where its commands stood still."""
    frames, is_zero = len(commands), np.all(commands == 0, axis=1)
    is_open = faults.mark(_longest(faults.runs(is_zero & good)), frames)
    yield from findings_in(is_open, "loop open", "commands", spoils=False)
    for axis, column in enumerate(commands.T):
        held = faults.mark(_longest(faults.equal_runs(column, good)), frames) & ~is_open
        yield from findings_in(held, "held", "commands", axis, spoils=False)


def _longest(stretches: IntArray) -> IntArray:
    return stretches[stretches[:, 1] - stretches[:, 0] >= _OPEN_FRAMES]


def _note_trends(series: FloatArray, good: BoolArray) -> Iterator[str]:
    """Note where the scatter from frame to frame changes between the ends of the record."""
    for axis, column in enumerate(series.T):
        first, last = end_scatters(column, good)
        if max(first, last) > TREND * min(first, last):
            yield (
                f"axis {axis} is not stationary: the rms difference of two frames is "
                f"{nm_text(first)} in the first quarter and {nm_text(last)} in the last"
            )


def end_scatters(series: FloatArray, good: BoolArray) -> tuple[float, float]:
    """Return the rms difference of two good frames in the first quarter, and in the last.

    nan where these are few.
    """
    steps = np.diff(series)[good[1:] & good[:-1]]
    quarter = steps.size // 4
    if quarter < SHORTEST_SEGMENT:
        return float("nan"), float("nan")
    first, last = (np.sqrt(np.mean(ends**2)) for ends in (steps[:quarter], steps[-quarter:]))
    return float(first), float(last)
