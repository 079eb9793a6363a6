"""Records from files of any origin, by what the file tells and what the call gives."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.files import load_telemetry
from lbt_synth.identification.records.column_selection import KINDS, Series, select_series
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.commands_file import join_commands
from lbt_synth.identification.records.contents import (
    FITS,
    Contents,
    name_in_errors,
    parse_contents,
    read_contents,
    read_record_bytes,
)
from lbt_synth.identification.records.from_arrays import loop_record
from lbt_synth.identification.records.from_telemetry import record_from_telemetry
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.spectrum import SpectrumRecord
from lbt_synth.identification.records.units import (
    density_unit,
    hz_per,
    nm_per,
    same_unit,
    seconds_per,
)
from lbt_synth.models import PositionLoop
from lbt_synth.storage.fits import has_card
from lbt_synth.validation import FloatArray, choice, number

_TELEMETRY_CARDS = ("LBTTELEM", "AOT-VERS")  # of our own telemetry, and of the AOT standard
_TELEMETRY_ARRAYS = {"META", "COMMANDS", "MEASURE"}
_RATES_HZ = (5.0, 1e5)  # plausible for times without a unit
_WHICH_UNITS = {
    "density": "nm^2/Hz, or mas^2/Hz of tilt; nm/sqrt(Hz) of an amplitude",
    "measurements": "nm, um, m of wavefront, or mas, arcsec, urad, rad of tilt",
}


def load_record(
    path: str | os.PathLike[str],
    *,
    kind: str | None = None,
    frame_rate_hz: float | None = None,
    delay_frames: float | None = None,
    unit: str | None = None,
    command_unit: str | None = None,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    mirror: PositionLoop | None = None,
    averages: int | None = None,
    axes: Sequence[int] | None = None,
    columns: Mapping[str, Any] | None = None,
    commands: str | os.PathLike[str] | None = None,
) -> LoopRecord | SpectrumRecord:
    r"""Read what a loop recorded: FITS, NPY, NPZ or CSV.

    Telemetry of this package and of the AOT standard is recognised. In other files, series are
    found by the names of columns, arrays and HDUs, rates and units by names and headers, as
    the page on records lists them. What the file does not tell has to be given; the notes of
    ``health`` say how the file was read.

    Parameters
    ----------
    path : path-like
        File that ends in .fits, .fit, .fts, .npy, .npz, .csv, .tsv, .txt or .dat.
    kind : {"closed_loop", "open_loop", "spectrum"}, optional
        Residual measurements with commands; the (pseudo-)open-loop series itself; or a power
        spectrum. By default what the names tell.
    frame_rate_hz : float, optional
        Frame rate [Hz], where the file does not tell it; a contradiction is refused.
    delay_frames : float, optional
        Total delay [frames], where the file does not tell it, or in place of that of the file.
    unit : str, optional
        Unit of the measurements (nm, um, m, mas, arcsec, urad, rad; of a spectrum nm^2/Hz or
        nm/sqrt(Hz) and so on), where the file does not tell it; a contradiction is refused.
    command_unit : str, optional
        The same of the commands; by default ``unit``.
    diameter_m, obstruction : float, optional
        Telescope diameter [m], and its central obstruction as a fraction of it.
    mirror : PositionLoop, optional
        Dynamics of the mirror.
    averages : int, optional
        Periodograms that were averaged in a spectrum.
    axes : sequence of int, optional
        Which columns of several, or which modes of telemetry, are the axes; from 0.
    columns : mapping, optional
        What names do not tell: names or numbers (from 0) of columns under "measurements",
        "open_loop", "commands", "times", "frame_numbers", "frequency", "density" or "amplitude".
    commands : path-like, optional
        Another file, with the commands. Rows are matched by the frame counters of both files,
        or else by the times of both; without a common clock, row by row.

    Returns
    -------
    LoopRecord or SpectrumRecord
        The record, in nm.

    Raises
    ------
    TelemetryError
        If a file is missing, damaged, or of another kind.
    ProblemError
        If something is needed that neither the file nor the call tells, or both differ.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder) / "night.csv"
    ...     _ = file.write_text("time_s,tip_mas,command_tip_mas\n0.000,3,0\n0.001,4,1\n0.002,,2\n")
    ...     seen = lbt.load_record(file, delay_frames=1, diameter_m=8.22)
    >>> seen.frame_rate_hz, seen.usable.tolist(), seen.measurements[0].round(2).tolist()
    (1000.0, [False, True, False], [29.89])
    """
    source = Path(path)
    if kind is not None:
        choice(kind, "kind", KINDS)
    content = read_record_bytes(source)
    if _is_telemetry(source, content):
        with name_in_errors(source):
            if kind not in (None, "closed_loop") or columns is not None or commands is not None:
                raise ProblemError(
                    "telemetry holds measurements and commands: kind must be closed_loop, and "
                    "neither columns nor commands be given. Choose its modes by axes."
                )
            if averages is not None:
                raise ProblemError("this is telemetry, and averages are of a spectrum.")
            return record_from_telemetry(
                load_telemetry(source),
                modes=None if axes is None else tuple(axes),
                frame_rate_hz=frame_rate_hz,
                delay_frames=delay_frames,
                mirror=mirror,
                unit=unit,
                command_unit=command_unit,
                diameter_m=diameter_m,
                obstruction=obstruction,
                source=str(source),
            )
    contents = parse_contents(source, content)
    with name_in_errors(source):
        if commands is not None:
            other = Path(commands)
            join_commands(contents, read_contents(other), other)
        series = select_series(contents, kind=kind, axes=axes, columns=columns)
        facts = {
            "frame_rate_hz": _find_fact(contents, "frame_rate_hz", frame_rate_hz, may_differ=False),
            "diameter_m": _find_fact(contents, "diameter_m", diameter_m),
            "source": str(source),
        }
        if series.kind == "spectrum":
            facts["averages"] = _find_fact(contents, "averages", averages)
            return _build_spectrum_record(series, contents, unit, **facts)
        if averages is not None:
            raise ProblemError(f"averages are of a spectrum; the record is of kind {series.kind}.")
        return _build_loop_record(
            series,
            contents,
            unit,
            command_unit,
            mirror=mirror,
            delay_frames=_find_fact(contents, "delay_frames", delay_frames),
            obstruction=_find_fact(contents, "obstruction", obstruction),
            **facts,
        )


def _is_telemetry(path: Path, content: bytes) -> bool:
    if path.suffix.lower() in FITS:
        return any(has_card(content, card) for card in _TELEMETRY_CARDS)
    if path.suffix.lower() != ".npz":
        return False
    try:
        names = {Path(name).stem for name in ZipFile(io.BytesIO(content)).namelist()}
    except (BadZipFile, OSError, ValueError):
        return False  # parse_contents says so
    return names >= _TELEMETRY_ARRAYS


def _find_fact(contents: Contents, name: str, given: Any, *, may_differ: bool = True) -> Any:
    """Return what was given, or what the file has; refuse two values of a file."""
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
            if not may_differ:
                raise ProblemError(
                    f"{name} must be that of the file, {value:.9g} by {where}; got {wanted:.9g}."
                )
            contents.notes.append(
                f"{name} {wanted:.9g} was given; the file has {value:.9g} by {where}"
            )
    return given


def _find_unit(
    chosen: Sequence[Column], given: str | None, contents: Contents, what: str, option: str = "unit"
) -> str:
    """Return the unit of some columns by their names or headers, the file, or the call."""
    facts = contents.facts.get(option, contents.facts.get("unit", {}))
    of_file = list(dict.fromkeys(map(str, facts.values())))
    found = {each.unit or (of_file[0] if of_file else "") for each in chosen}
    if len(found) > 1 or len(of_file) > 1:
        raise ProblemError(
            f"the {what} must all have the same unit; got "
            f"{', '.join(sorted(found.union(of_file)))}."
        )
    (own,) = found
    if not own and given is None:
        raise ProblemError(
            f"the file does not tell the unit of the {what}; give {option} "
            f"({_WHICH_UNITS.get(what, _WHICH_UNITS['measurements'])})."
        )
    if own and given is not None and not same_unit(own, given):
        raise ProblemError(f"{option} must be that of the file, {own!r}; got {given!r}.")
    return own or str(given)


def _stack_columns(chosen: Sequence[Column]) -> FloatArray:
    sizes = {len(each.values) for each in chosen}
    if len(sizes) > 1:
        raise ProblemError(
            f"{' and '.join(each.name for each in chosen)} must be equally long; got "
            f"{' and '.join(map(str, sorted(sizes)))} rows."
        )
    return np.column_stack([each.values for each in chosen])


def _build_loop_record(
    series: Series, contents: Contents, unit: str | None, command_unit: str | None, **facts: Any
) -> LoopRecord:
    y, u = series.columns[series.role], series.columns.get("commands")
    (clock,) = series.columns.get("times", [None])
    (counter,) = series.columns.get("frame_numbers", [None])
    y_unit, u_unit = _find_unit(y, unit, contents, "measurements"), None
    if u is not None:
        u_unit = _find_unit(u, command_unit or unit, contents, "commands", "command_unit")
    times = None if clock is None else seconds_per(clock.unit) * clock.values
    if clock is not None and not clock.unit:
        contents.notes.append(f"{clock.name} was taken for seconds")
    record = loop_record(
        _stack_columns(y),
        None if u is None else _stack_columns(u),
        unit=y_unit,
        command_unit=u_unit,
        times_s=times,
        frame_numbers=None if counter is None else counter.values,
        notes=contents.notes,
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


def _build_spectrum_record(
    series: Series, contents: Contents, unit: str | None, *, diameter_m: float | None, **facts: Any
) -> SpectrumRecord:
    densities, (frequency,) = series.columns[series.role], series.columns["frequency"]
    text = _find_unit(densities, unit, contents, "density")
    parted = density_unit(text)
    if parted is None:
        raise ProblemError(
            f"the unit of a density is a square over Hz (nm^2/Hz, mas^2/Hz), or a length or angle "
            f"over sqrt(Hz) (nm/sqrt(Hz)); got {text!r}."
        )
    name, power = parted
    if series.role == "amplitude" and power == 2:
        raise ProblemError(
            f"{densities[0].name} is named as an amplitude, but has the unit {text!r} of a power; "
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
        notes=tuple(dict.fromkeys(contents.notes)),
        **facts,
    )
