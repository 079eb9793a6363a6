"""Records from columns of a source: its facts and units, and those of the call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
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
from lbt_synth.identification.records.contents import Contents, Roles, join_names
from lbt_synth.identification.records.faults import merge_notes
from lbt_synth.identification.records.from_series import loop_record
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.validation import FloatArray, number

_RATES_HZ = (5.0, 1e5)  # plausible for times without a unit
FACTS = ("frame_rate_hz", "diameter_m", "delay_frames", "obstruction")
_UNITS = {
    "loop": "nm, um, m of wavefront, or mas, arcsec, urad, rad of tilt",
    "spectrum": "nm^2/Hz, or mas^2/Hz of tilt; nm/sqrt(Hz) of an amplitude",
}


def build_loop(
    roles: Roles,
    contents: Contents,
    *,
    unit: str | None,
    command_unit: str | None,
    mirror: PositionLoop | None,
    source: str,
    **given: Any,
) -> LoopRecord:
    """Make a record of series; ``given`` are facts, None where the source has to tell."""
    (role, columns), commands = next(iter(roles.items())), roles.get("commands")
    facts = {name: _find_fact(contents, name, given[name]) for name in FACTS}
    units = {role: _find_unit(columns, unit, contents)}
    if commands is not None:
        units["commands"] = (
            _find_unit(commands, command_unit, contents, "command_unit") or unit or ""
        )
    _require_facts(roles, units, facts)
    (clock,), (counter,) = (roles.get(name, [None]) for name in ("times", "frame_numbers"))
    times = None if clock is None else seconds_per(clock.unit) * clock.values
    if clock is not None and not clock.unit:
        contents.notes.append(f"{clock.name} was taken for seconds")
    record = loop_record(
        _stack_columns(columns),
        None if commands is None else _stack_columns(commands),
        unit=units[role],
        command_unit=units.get("commands"),
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
    roles: Roles, units: Mapping[str, str], facts: Mapping[str, Any], kind: str = "loop"
) -> None:
    """Refuse series of which facts are missing, all of them in one message."""
    bare = [role for role, unit in units.items() if not unit]
    option = "command_unit" if bare == ["commands"] else "unit"
    names = join_names([column for role in bare for column in roles[role]])
    angles = any(map(is_angle, units.values()))
    no_rate = facts["frame_rate_hz"] is None and "times" not in roles and kind == "loop"
    no_delay = "commands" in roles and facts["delay_frames"] is None
    lacks = {
        f"the unit of {names}: give {option} ({_UNITS[kind]})": bare,
        "the telescope, by which angles become nm: give diameter_m": (
            angles and facts["diameter_m"] is None
        ),
        "the frame rate: give frame_rate_hz, or the times": no_rate,
        "the total delay: give delay_frames": no_delay,
    }
    missing = [text for text, is_missing in lacks.items() if is_missing]
    if len(missing) > 1 or bare:
        volts = VOLTS if bare and option == "command_unit" else {}
        raise ProblemError(f"nothing tells {'; '.join(missing)}.", **volts)


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
    columns: Sequence[Column], stated: str | None, contents: Contents, option: str = "unit"
) -> str:
    """Return the unit of some columns by their names or headers, the source, or the call."""
    places = contents.facts.get(option, contents.facts.get("unit", {}))
    of_file = list(dict.fromkeys(map(str, places.values())))
    units = {column.unit or (of_file[0] if of_file else "") for column in columns}
    if len(units) > 1 or len(of_file) > 1:
        raise ProblemError(
            f"{join_names(columns)} must all have the same unit; got "
            f"{', '.join(sorted(units.union(of_file)))}."
        )
    (unit,) = units
    if unit and stated is not None and not same_unit(unit, stated):
        raise ProblemError(
            f"{option} must be that of the data, {unit!r}; got {stated!r}.",
            at_terminal="Leave it out; --show-unit is the unit of what is shown.",
        )
    return str(unit or stated or "")


def _stack_columns(chosen: Sequence[Column]) -> FloatArray:
    sizes = {len(column.values) for column in chosen}
    if len(sizes) > 1:
        raise ProblemError(
            f"{' and '.join(column.name for column in chosen)} must be equally long; got "
            f"{' and '.join(map(str, sorted(sizes)))} rows."
        )
    return np.column_stack([column.values for column in chosen])


def build_spectrum(
    roles: Roles, contents: Contents, *, unit: str | None, source: str, **given: Any
) -> SpectrumRecord:
    """Make a record of densities; ``given`` are facts, None where the source has to tell."""
    densities, (frequency,) = roles["density"], roles["frequency"]
    names = ("frame_rate_hz", "diameter_m", "averages")
    facts = {name: _find_fact(contents, name, given[name]) for name in names}
    own_unit = _find_unit(densities, unit, contents)
    _require_facts(roles, {"density": own_unit}, facts, "spectrum")
    parted = density_unit(own_unit)
    if parted is None:
        raise ProblemError(
            f"the unit of a density is a square over Hz (nm^2/Hz, mas^2/Hz), or a length or angle "
            f"over sqrt(Hz) (nm/sqrt(Hz)); got {own_unit!r}."
        )
    name, power = parted
    if not frequency.unit:
        contents.notes.append("frequencies were taken for Hz")
    table = _stack_columns([frequency, *densities])
    complete = np.all(np.isfinite(table), axis=1)
    if not complete.all():
        contents.notes.append(f"{int(np.sum(~complete))} rows with gaps were left out")
    table = table[complete]
    scaled = nm_per(name, diameter_m=facts["diameter_m"]) ** power * table[:, 1:]
    if power == 1:
        if np.any(scaled < 0):
            raise ProblemError("an amplitude density must be at least 0; got a negative one.")
        contents.notes.append("amplitude densities were squared")
        scaled = scaled**2
    return SpectrumRecord(
        frequency_hz=hz_per(frequency.unit) * table[:, 0],
        density_nm2_hz=scaled,
        notes=merge_notes(contents.notes),
        source=source,
        **facts,
    )
