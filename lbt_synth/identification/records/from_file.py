"""Records from files of any origin, by what the file tells and what the call gives."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.files import load_telemetry
from lbt_synth.identification.records.column_selection import Series, select_series
from lbt_synth.identification.records.columns import Column
from lbt_synth.identification.records.commands_file import join_commands
from lbt_synth.identification.records.contents import ENDINGS, FITS, Contents, read_contents
from lbt_synth.identification.records.from_arrays import loop_record
from lbt_synth.identification.records.from_telemetry import record_from_telemetry
from lbt_synth.identification.records.health import merge_notes
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.spectrum import SpectrumRecord
from lbt_synth.identification.records.units import (
    density_unit,
    hz_per,
    nm_per,
    seconds_per,
    unit_name,
)
from lbt_synth.models import PositionLoop
from lbt_synth.storage.fits import has_card
from lbt_synth.validation import FloatArray, choice, number

KINDS = ("closed_loop", "open_loop", "spectrum")
_OURS = "LBTTELEM"  # card of our own telemetry
_AOT = "AOT-VERS"
_ARRAYS_OF_OURS = {"META", "COMMANDS", "MEASURE"}
_RATES_HZ = (5.0, 1e5)  # plausible for times without a unit


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
    content = _read_bytes(source)
    if _is_telemetry(source, content):
        if kind not in (None, "closed_loop") or columns is not None or commands is not None:
            raise ProblemError(
                f"{source} is telemetry with measurements and commands: kind must be closed_loop, "
                "and neither columns nor commands be given. Choose its modes by axes."
            )
        if averages is not None:
            raise ProblemError(f"{source} is telemetry: averages are of a spectrum.")
        with _name_in_errors(source):
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
    contents = read_contents(source, content)
    if commands is not None:
        other = Path(commands)
        join_commands(contents, read_contents(other, _read_bytes(other)), other)
    with _name_in_errors(source):
        series = select_series(contents, kind=kind, axes=axes, columns=columns)
        facts = {
            "frame_rate_hz": _find_fact(contents, "frame_rate_hz", frame_rate_hz, may_differ=False),
            "diameter_m": _find_fact(contents, "diameter_m", diameter_m),
            "source": str(source),
            "unit": unit,
        }
        if series.kind == "spectrum":
            facts["averages"] = _find_fact(contents, "averages", averages)
            return _build_spectrum_record(series, contents, **facts)
        if averages is not None:
            raise ProblemError(f"averages are of a spectrum; the record is of kind {series.kind}.")
        return _build_loop_record(
            series,
            contents,
            command_unit=command_unit,
            mirror=mirror,
            delay_frames=_find_fact(contents, "delay_frames", delay_frames),
            obstruction=_find_fact(contents, "obstruction", obstruction),
            **facts,
        )


@contextmanager
def _name_in_errors(source: Path) -> Iterator[None]:
    """Name the file in errors that do not name it yet."""
    try:
        yield
    except TelemetryError:
        raise
    except ProblemError as error:
        raise type(error)(f"{source}: {error}") from error


def _read_bytes(path: Path) -> bytes:
    if path.suffix.lower() not in ENDINGS:
        raise TelemetryError(
            f"a record must end in one of {', '.join(ENDINGS)}; got {path.name!r}.", path=path
        )
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise TelemetryError(f"cannot read {path}: {why}.", path=path) from error


def _is_telemetry(path: Path, content: bytes) -> bool:
    if path.suffix.lower() in FITS:
        return has_card(content, _OURS) or has_card(content, _AOT)
    if path.suffix.lower() != ".npz":
        return False
    try:
        names = {Path(name).stem for name in ZipFile(io.BytesIO(content)).namelist()}
    except (BadZipFile, OSError, ValueError):
        return False  # read_contents says so
    return names >= _ARRAYS_OF_OURS


def _find_fact(contents: Contents, name: str, given: Any, *, may_differ: bool = True) -> Any:
    """Return what was given, or what the file has; refuse two values of a file."""
    places = contents.facts.get(name, {})
    own = {where: number(value, f"{where} ({name})") for where, value in places.items()}
    first = next(iter(own), None)
    if given is None:
        if len(set(own.values())) > 1:
            found = ", ".join(f"{value:.9g} by {where}" for where, value in own.items())
            raise ProblemError(f"the file gives {name} twice: {found}. Choose one in the call.")
        if first is None:
            return None
        contents.notes.append(f"{name} {own[first]:.9g}, by {first}")
        return int(own[first]) if name == "averages" else own[first]
    wanted = number(given, name)
    others = {where: value for where, value in own.items() if abs(value - wanted) > 1e-6 * wanted}
    for where, value in others.items():
        if not may_differ:
            raise ProblemError(
                f"{name} must be that of the file, {value:.9g} by {where}; got {wanted:.9g}."
            )
        contents.notes.append(f"{name} {wanted:.9g} was given; the file has {value:.9g} by {where}")
    return given


def _build_loop_record(
    series: Series, contents: Contents, *, unit: str | None, command_unit: str | None, **facts: Any
) -> LoopRecord:
    y_unit = _find_unit(series.measurements, unit, contents, "unit", "measurements")
    u_unit = None
    if series.commands:
        given = unit if command_unit is None else command_unit
        fact = "command unit" if "command unit" in contents.facts else "unit"
        u_unit = _find_unit(series.commands, given, contents, fact, "commands")
    times = None
    if series.times is not None:
        times = seconds_per(series.times.unit) * series.times.values
        if not series.times.unit:
            contents.notes.append(f"{series.times.name} was taken for seconds")
    record = loop_record(
        _stack_columns(series.measurements),
        _stack_columns(series.commands) if series.commands else None,
        unit=y_unit,
        command_unit=u_unit,
        times_s=times,
        frame_numbers=None if series.frame_numbers is None else series.frame_numbers.values,
        notes=merge_notes(contents.notes, series.notes),
        **facts,
    )
    if series.times is not None and not series.times.unit:
        low, high = _RATES_HZ
        if facts["frame_rate_hz"] is None and not low <= record.frame_rate_hz <= high:
            raise ProblemError(
                f"the frame rate would be {record.frame_rate_hz:.6g} Hz with "
                f"{series.times.name or 'the times'} in seconds, and their unit is not given; name "
                "it, as in time_ms, or give frame_rate_hz."
            )
    return record


def _find_unit(
    chosen: Sequence[Column], given: str | None, contents: Contents, fact: str, what: str
) -> str:
    """Return the unit of some columns by their names or headers, the file, or the call."""
    units = {str(value): where for where, value in contents.facts.get(fact, {}).items()}
    found = {each.unit or next(iter(units), "") for each in chosen}
    if len(found) > 1 or len(units) > 1:
        raise ProblemError(
            f"the {what} must all have the same unit; got {', '.join(sorted(found | set(units)))}."
        )
    own = found.pop()
    option = "command_unit" if what == "commands" else "unit"
    if not own:
        if given is None:
            choices = (
                "nm^2/Hz, or mas^2/Hz of tilt; nm/sqrt(Hz) of an amplitude"
                if what == "density"
                else "nm, um, m of wavefront, or mas, arcsec, urad, rad of tilt"
            )
            raise ProblemError(
                f"the file does not tell the unit of the {what}; give {option} ({choices})."
            )
        return given
    if given is not None and _unit_key(own) != _unit_key(given):
        raise ProblemError(f"{option} must be that of the file, {own!r}; got {given!r}.")
    return own


def _unit_key(text: str) -> Any:
    return density_unit(text) or unit_name(text) or text


def _stack_columns(chosen: Sequence[Column]) -> FloatArray:
    sizes = {len(each.values) for each in chosen}
    if len(sizes) > 1:
        raise ProblemError(
            f"{' and '.join(each.name for each in chosen)} must be equally long; got "
            f"{' and '.join(map(str, sorted(sizes)))} rows."
        )
    return np.column_stack([each.values for each in chosen])


def _build_spectrum_record(
    series: Series, contents: Contents, *, unit: str | None, diameter_m: float | None, **facts: Any
) -> SpectrumRecord:
    assert series.frequency is not None
    text = _find_unit(series.measurements, unit, contents, "unit", "density")
    parted = density_unit(text)
    if parted is None:
        raise ProblemError(
            f"the unit of a density is a square over Hz (nm^2/Hz, mas^2/Hz), or a length or angle "
            f"over sqrt(Hz) (nm/sqrt(Hz)); got {text!r}."
        )
    if series.amplitude and parted[1] == 2:
        raise ProblemError(
            f"{series.measurements[0].name} is named as an amplitude, but has the unit {text!r} of "
            "a power; choose by columns={'density': ...}."
        )
    scale_hz = hz_per(series.frequency.unit)
    if not series.frequency.unit:
        contents.notes.append("frequencies were taken for Hz")
    table = _stack_columns([series.frequency, *series.measurements])
    complete = np.all(np.isfinite(table), axis=1)
    if not complete.all():
        contents.notes.append(f"{int(np.sum(~complete))} rows with gaps were left out")
    table = table[complete]
    scaled = nm_per(parted[0], diameter_m=diameter_m) ** parted[1] * table[:, 1:]
    if parted[1] == 1:
        if np.any(scaled < 0):
            raise ProblemError("an amplitude density must be at least 0; got a negative one.")
        contents.notes.append("amplitude densities were squared")
        scaled = scaled**2
    return SpectrumRecord(
        frequency_hz=scale_hz * table[:, 0],
        density_nm2_hz=scaled,
        diameter_m=diameter_m,
        notes=merge_notes(contents.notes, series.notes),
        **facts,
    )
