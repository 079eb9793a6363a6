"""Records from named series, by what their source tells and what the call gives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records import units
from lbt_synth.identification.records.column_selection import Series, join_names
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.contents import Contents
from lbt_synth.identification.records.from_arrays import loop_record
from lbt_synth.identification.records.health import merge_notes
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.spectrum import SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.validation import FloatArray, number

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
        raise ProblemError(f"averages are of a spectrum; the record is of kind {series.kind}.")
    facts = {name: _find_fact(contents, name, given[name]) for name in _FACTS[kind]}
    own_unit = _find_unit(series.columns[series.role], unit, contents, kind)
    if kind == "spectrum":
        return _build_spectrum(series, contents, own_unit, source=source, **facts)
    u, u_unit = series.columns.get("commands"), None
    if u is not None:
        u_unit = _find_unit(u, command_unit or unit, contents, kind, "command_unit")
    (clock,) = series.columns.get("times", [None])
    (counter,) = series.columns.get("frame_numbers", [None])
    times = None if clock is None else units.seconds_per(clock.unit) * clock.values
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
            f"nothing tells the unit of {join_names(chosen)}; give {option} ({_UNITS[kind]})."
        )
    if own and given is not None and not units.same_unit(own, given):
        raise ProblemError(f"{option} must be that of the data, {own!r}; got {given!r}.")
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
    parted = units.density_unit(unit)
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
    scaled = units.nm_per(name, diameter_m=diameter_m) ** power * table[:, 1:]
    if power == 1:
        if np.any(scaled < 0):
            raise ProblemError("an amplitude density must be at least 0; got a negative one.")
        contents.notes.append("amplitude densities were squared")
        scaled = scaled**2
    return SpectrumRecord(
        frequency_hz=units.hz_per(frequency.unit) * table[:, 0],
        density_nm2_hz=scaled,
        diameter_m=diameter_m,
        notes=merge_notes(contents.notes),
        **facts,
    )
