"""Records from named series, whose commands may be in a second file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.identification.records.column_selection import (
    CLOCKS,
    Series,
    join_names,
    number_axes,
)
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
from lbt_synth.identification.records.contents import Contents
from lbt_synth.identification.records.faults import merge_notes
from lbt_synth.identification.records.from_arrays import loop_record
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.spectrum import SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.validation import FloatArray, IntArray, number

_RATES_HZ = (5.0, 1e5)  # plausible for times without a unit
_FACTS = {
    "loop": ("frame_rate_hz", "diameter_m", "delay_frames", "obstruction"),
    "spectrum": ("frame_rate_hz", "diameter_m", "averages"),
}
_UNITS = {
    "loop": "nm, um, m of wavefront, or mas, arcsec, urad, rad of tilt",
    "spectrum": "nm^2/Hz, or mas^2/Hz of tilt; nm/sqrt(Hz) of an amplitude",
}


def build_record(
    series: Series,
    contents: Contents,
    *,
    unit: str | None,
    command_unit: str | None,
    mirror: PositionLoop | None,
    source: str,
    **given: Any,
) -> LoopRecord | SpectrumRecord:
    """Make a record; ``given`` are the facts of the call, None where the source has to tell."""
    kind = "spectrum" if series.kind == "spectrum" else "loop"
    if kind == "loop" and given.pop("averages", None) is not None:
        raise ProblemError(
            f"averages are only for a spectrum; the record is of kind {series.kind}."
        )
    facts = {name: _find_fact(contents, name, given[name]) for name in _FACTS[kind]}
    if kind == "loop":
        units = {series.role: unit, "commands": command_unit or unit}
        _require_facts(series, contents, units, facts)
    own_unit = _find_unit(series.columns[series.role], unit, contents, kind)
    if kind == "spectrum":
        return _build_spectrum(series, contents, own_unit, source=source, **facts)
    u, u_unit = series.columns.get("commands"), None
    if u is not None:
        u_unit = _find_unit(u, command_unit or unit, contents, kind, "command_unit")
    (clock,) = series.columns.get("times", [None])
    (counter,) = series.columns.get("frame_numbers", [None])
    times = None if clock is None else seconds_per(clock.unit) * clock.values
    if clock is not None and not clock.unit:
        contents.notes.append(f"{clock.name} was taken for seconds")
    record = loop_record(
        _stack_columns(series.columns[series.role]),
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
    series: Series, contents: Contents, units: Mapping[str, str | None], facts: Mapping[str, Any]
) -> None:
    """Refuse a loop of which several facts are missing, all of them in one message."""
    of_file = "".join(map(str, contents.facts.get("unit", {}).values()))
    found = [
        (column, column.unit or of_file or unit or "")
        for role, unit in units.items()
        for column in series.columns.get(role, ())
    ]
    bare = [column for column, unit in found if not unit]
    angles = facts["diameter_m"] is None and any(is_angle(unit) for _, unit in found)
    no_rate = facts["frame_rate_hz"] is None and "times" not in series.columns
    no_delay = facts["delay_frames"] is None and "commands" in series.columns
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
    own = {where: number(value, f"{where} ({name})") for where, value in places.items()}
    if given is None:
        if len(set(own.values())) > 1:
            found = ", ".join(f"{value:.9g} by {where}" for where, value in own.items())
            raise ProblemError(f"the file gives {name} twice: {found}. Choose one in the call.")
        for where, value in own.items():
            contents.notes.append(f"{name} {value:.9g}, by {where}")
            return int(value) if name == "averages" else value
        return None
    wanted = number(given, name)
    for where, value in own.items():
        if abs(value - wanted) > 1e-6 * wanted:
            if name == "frame_rate_hz":
                raise ProblemError(
                    f"{name} must be that of {where}, {value:.9g}; got {wanted:.9g}."
                )
            contents.notes.append(f"{name} {wanted:.9g} was given; {where} has {value:.9g}")
    return given


def _find_unit(
    chosen: Sequence[Column], given: str | None, contents: Contents, kind: str, option: str = "unit"
) -> str:
    """Return the unit of some columns by their names or headers, the source, or the call."""
    facts = contents.facts.get(option, contents.facts.get("unit", {}))
    of_file = list(dict.fromkeys(map(str, facts.values())))
    found = {each.unit or (of_file[0] if of_file else "") for each in chosen}
    if len(found) > 1 or len(of_file) > 1:
        raise ProblemError(
            f"{join_names(chosen)} must all have the same unit; got "
            f"{', '.join(sorted(found.union(of_file)))}."
        )
    (own,) = found
    if not own and given is None:
        raise ProblemError(
            f"nothing tells the unit of {join_names(chosen)}; give {option} ({_UNITS[kind]}).",
            **(VOLTS if option == "command_unit" else {}),
        )
    if own and given is not None and not same_unit(own, given):
        raise ProblemError(
            f"{option} must be that of the data, {own!r}; got {given!r}.",
            at_terminal="Leave it out; --show-unit is the unit of what is shown.",
        )
    return own or str(given)


def _stack_columns(chosen: Sequence[Column]) -> FloatArray:
    sizes = {len(each.values) for each in chosen}
    if len(sizes) > 1:
        raise ProblemError(
            f"{' and '.join(each.name for each in chosen)} must be equally long; got "
            f"{' and '.join(map(str, sorted(sizes)))} rows."
        )
    return np.column_stack([each.values for each in chosen])


def _build_spectrum(
    series: Series, contents: Contents, unit: str, *, diameter_m: float | None, **facts: Any
) -> SpectrumRecord:
    densities, (frequency,) = series.columns[series.role], series.columns["frequency"]
    parted = density_unit(unit)
    if parted is None:
        raise ProblemError(
            f"the unit of a density is a square over Hz (nm^2/Hz, mas^2/Hz), or a length or angle "
            f"over sqrt(Hz) (nm/sqrt(Hz)); got {unit!r}."
        )
    name, power = parted
    if series.role == "amplitude" and power == 2:
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


_SAME_TIME = 0.25  # of a step
_LEAST_SHARE = 0.5  # of the measurements, that have a command


def join_commands(contents: Contents, other: Contents, path: Path) -> None:
    """Add the commands of another file, in place of those of the first.

    Rows are matched by the counters of both files, or else by the times of both (within a
    quarter of a step). Without a common clock both files must have equally many rows.
    """
    named = [each for each in other.columns if each.role == "commands"] or [
        each for each in other.columns if each.role in (None, "measurements")
    ]
    if not named:
        raise TelemetryError(f"{path} holds no commands.", path=path)
    named = _match_commands(contents, other, named, path)
    if len(named) > 1 and any(each.axis is None for each in named):
        named = number_axes(named)
    own = [each for each in contents.columns if each.role != "commands"]
    if not any(each.role in ("measurements", "open_loop") for each in own):
        plain = number_axes([each for each in own if each.role is None])
        own = [each for each in own if each.role is not None]
        own += [replace(each, role="measurements") for each in plain]
    contents.columns = own + [replace(each, role="commands") for each in named]
    for fact, places in other.facts.items():
        if fact != "unit":
            for where, value in places.items():
                contents.facts.setdefault(fact, {})[f"{where} in {path.name}"] = value
    # a unit is that of its own file
    contents.facts["command_unit"] = dict(other.facts.get("unit", {}))
    contents.notes += [f"commands are from {path}", *other.notes]


def _match_commands(
    contents: Contents, other: Contents, named: list[Column], path: Path
) -> list[Column]:
    """Return the commands in the rows of the measurements, NaN where there are none."""
    rows, counts = ({len(each.values) for each in own} for own in (contents.columns, named))
    for role in CLOCKS:
        mine, theirs = (_find_clock(file, role) for file in (contents, other))
        if mine is None or theirs is None:
            continue
        if rows != {len(mine.values)} or counts != {len(theirs.values)}:
            break  # refused below
        at = _match_rows(_clock_values(mine), _clock_values(theirs), role, path)
        if np.array_equal(at, np.arange(len(theirs.values))):
            return named
        there = at >= 0
        contents.notes.append(
            f"commands were laid beside the measurements by {theirs.name}: {int(np.sum(there))} of "
            f"{len(at)} rows have one"
        )
        return [replace(each, values=np.where(there, each.values[at], np.nan)) for each in named]
    if len(rows | counts) > 1:
        raise TelemetryError(
            f"{path} must have as many frames as the measurements; got "
            f"{', '.join(map(str, sorted(rows | counts)))}. Or give both files a counter of "
            "frames, or times.",
            path=path,
        )
    if any(each.role in CLOCKS for each in (*contents.columns, *other.columns)):
        contents.notes.append(
            "the files have no clock in common: rows of the same number were taken for one frame"
        )
    return named


def _find_clock(file: Contents, role: str) -> Column | None:
    """Return the clock of a file, if it has one and not more."""
    found = [each for each in file.columns if each.role == role]
    return found[0] if len(found) == 1 else None


def _clock_values(clock: Column) -> FloatArray:
    return clock.values * (seconds_per(clock.unit) if clock.role == "times" else 1.0)


def _match_rows(one: FloatArray, other: FloatArray, role: str, path: Path) -> IntArray:
    """Return the row of the second clock for each row of the first, -1 where there is none."""
    if not all(np.all(np.isfinite(each)) and np.all(np.diff(each) >= 0) for each in (one, other)):
        raise TelemetryError(f"the {role} of both files must rise, without gaps.", path=path)
    if np.array_equal(one, other):
        return np.arange(len(one))
    if np.any(np.diff(other) <= 0):
        raise TelemetryError(
            f"the {role} of {path} must rise from row to row to be matched with those of the "
            "measurements; got two rows alike.",
            path=path,
        )
    near = _SAME_TIME * min(map(_median_step, (one, other))) if role == "times" else 0.0
    at = np.searchsorted((other[1:] + other[:-1]) / 2, one, side="right")
    at = np.where(np.abs(other[at] - one) <= near, at, -1)
    if np.mean(at >= 0) < _LEAST_SHARE:
        raise TelemetryError(
            f"only {int(np.sum(at >= 0))} of {len(one)} measurements have a command in {path} by "
            f"their {role}; they go from {one[0]:.12g} to {one[-1]:.12g} and from {other[0]:.12g} "
            f"to {other[-1]:.12g}. Give files of the same frames, or leave the {role} away in one "
            "of them if the rows do belong together.",
            path=path,
        )
    return at


def _median_step(clock: FloatArray) -> float:
    steps = np.diff(clock)
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
