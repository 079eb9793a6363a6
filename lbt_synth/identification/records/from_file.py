"""Records from files of any origin, from telemetry, and from a second file with the commands."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.files import Telemetry, load_telemetry
from lbt_synth.identification.records.columns import Column, seconds_per, unit_name
from lbt_synth.identification.records.contents import (
    CLOCKS,
    FITS,
    KINDS,
    Contents,
    choose_axes,
    name_in_errors,
    number_axes,
    read_contents,
    select_series,
)
from lbt_synth.identification.records.from_columns import FACTS, build_loop, build_spectrum
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import read_cards
from lbt_synth.storage.input_files import LARGEST_TEXT_BYTES, open_input
from lbt_synth.validation import FloatArray, IntArray, choice

_TELEMETRY_CARDS = ("LBTTELEM", "AOT-VERS")  # of this package, and of the AOT standard
_TELEMETRY_ARRAYS = {"META", "MEASURE"}
_FOREIGN = "timing"  # key of metadata in telemetry of other programs
_STATED_GAIN, _READ_WITH = "stated_sensor_gain", "commands_read_with"  # of a record that was read
_CONDITION = float(np.finfo(np.float64).eps ** -0.5)  # beyond, an inverse is half rounding
_SAME_TIME = 0.25  # of a step, within which two rows are of one frame


def load_record(
    source: str | os.PathLike[str] | Telemetry,
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
    r"""Read what a loop recorded: FITS, NPY, NPZ, CSV, or telemetry.

    Telemetry of this package and of the AOT standard is recognised; its measurements and commands
    become modes by its matrices. In other files, series are found by the names of columns, arrays
    and HDUs, rates and units by names and headers, as the page on records lists them. What the
    source does not tell has to be given; the notes of ``health`` say how it was read.

    Parameters
    ----------
    source : path-like or Telemetry
        Telemetry, or a file that ends in .fits, .fit, .fts, .npy, .npz, .csv, .tsv, .txt or .dat.
    kind : {"closed_loop", "open_loop", "spectrum"}, optional
        Residual measurements with commands; the (pseudo-)open-loop series itself; or a power
        spectrum. By default what the names tell.
    frame_rate_hz, unit, command_unit : optional
        As for :func:`loop_record`, where the source does not tell them; a contradiction is refused.
        The unit of a spectrum is nm^2/Hz or nm/sqrt(Hz) and so on.
    delay_frames, diameter_m, obstruction, mirror : optional
        As for :func:`loop_record`; the delay also in place of that of the source.
    averages : int, optional
        Periodograms that were averaged in a spectrum.
    axes : sequence of int, optional
        Which columns of several, or which modes of telemetry, are the axes; from 0.
    columns : mapping, optional
        What names do not tell: names or numbers (from 0) of columns under "measurements",
        "open_loop", "commands", "times", "frame_numbers", "frequency" or "density".
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
        If a fact is missing from both the file and the call, or the two contradict.

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
    given: dict[str, Any] = {
        "frame_rate_hz": frame_rate_hz,
        "delay_frames": delay_frames,
        "unit": unit,
        "command_unit": command_unit,
        "diameter_m": diameter_m,
        "obstruction": obstruction,
        "mirror": mirror,
    }
    if kind is not None:
        choice(kind, "kind", tuple(KINDS))
    of_telemetry = columns is None and commands is None
    if isinstance(source, Telemetry):
        _require_series(of_telemetry, averages)
        given["source"] = source.name or "telemetry"
        return _telemetry_record(source, kind=kind, axes=axes, **given)
    path = Path(source)
    given["source"] = str(path)
    with name_in_errors(path):
        if is_telemetry(path):
            _require_series(of_telemetry, averages)
            return _telemetry_record(load_telemetry(path), kind=kind, axes=axes, **given)
        contents = read_contents(path)
        if commands is not None:
            _join_commands(contents, Path(commands))
        kind, roles = select_series(contents, kind=kind, axes=axes, columns=columns)
        if kind == "spectrum":
            return build_spectrum(roles, contents, averages=averages, **given)
        _require_series(True, averages)
        return build_loop(roles, contents, **given)


def _require_series(of_telemetry: bool, averages: int | None) -> None:
    """Refuse what telemetry and series do not take."""
    if not of_telemetry:
        raise ProblemError(
            "telemetry says what its series are: neither columns nor commands may be given. Choose "
            "its modes with axes."
        )
    if averages is not None:
        raise ProblemError("averages are only for a spectrum; got a record of series.")


def is_telemetry(path: str | os.PathLike[str]) -> bool:
    """Whether a file is telemetry of this package or of the AOT standard."""
    path = Path(path)
    try:
        if path.suffix.lower() in FITS:
            with open_input(path, TelemetryError) as stream:
                header = io.BytesIO(stream.read(LARGEST_TEXT_BYTES))
            return bool(read_cards(header, _TELEMETRY_CARDS))
        if path.suffix.lower() != ".npz":
            return False
        with open_input(path, TelemetryError) as stream:
            names = ZipFile(stream).namelist()
    except Exception:  # zipfile raises many kinds; read_contents reports the error
        return False
    return {Path(name).stem for name in names} >= _TELEMETRY_ARRAYS


def _telemetry_record(
    telemetry: Telemetry,
    *,
    kind: str | None,
    axes: Sequence[int] | None,
    mirror: PositionLoop | None,
    **given: Any,
) -> LoopRecord:
    """Make a record of tip and tilt; ``given`` are facts, None where the telemetry has to tell.

    Measurements become modes by the inverse of the interaction matrix, commands by the influence
    matrix, where there are such. A matrix of gains alone, one for each mode, is no mixture: these
    measurements stay as they were recorded, and the sensor gain of the record is what they show of
    a unit of phase.
    """
    n, is_open = telemetry.modes, telemetry.commands is None
    if kind not in (None, stored := "open_loop" if is_open else "closed_loop"):
        raise ProblemError(f"this telemetry is of kind {stored}; got {kind}. Leave kind out.")
    chosen = choose_axes(axes, n, "modes")
    facts = {name: value for name in FACTS if (value := getattr(telemetry, name)) is not None}
    contents = Contents(facts={name: {"the telemetry": value} for name, value in facts.items()})
    held = [role for role in _MATRICES if getattr(telemetry, role) is not None]
    roles = {role: _modal_columns(telemetry, role, chosen, contents.notes) for role in held}
    if telemetry.times_s is not None:
        roles["times"] = [Column(name="times_s", values=telemetry.times_s, unit="s")]
    if max(n, telemetry.measurements.shape[1], telemetry.n_commands) > len(chosen):
        contents.notes.append(f"axes are modes {', '.join(map(str, chosen))} of {n}")
    if _FOREIGN in telemetry.metadata:
        contents.notes.append(
            "of another program: that y(k) is of the exposure of frame k-1 is taken for granted"
        )
    mirror = telemetry.mirror if mirror is None else mirror
    record = build_loop(roles, contents, mirror=mirror, **given)
    gains = tuple(map(float, str(telemetry.metadata.get(_STATED_GAIN, "")).split()))
    return replace(
        record,
        imaging_wavelength_um=telemetry.imaging_wavelength_um,
        stated_gain=tuple(gains[k] for k in chosen) if len(gains) == n else gains,
        read_with=str(telemetry.metadata.get(_READ_WITH, "")),
    )


def telemetry_of_record(record: LoopRecord) -> Telemetry:
    """Return a record as telemetry, from which it can be read again without any other fact."""
    y, u = record.measurements, record.commands
    gains = " ".join(f"{gain:.9g}" for gain in record.stated_gain)
    stated = {_STATED_GAIN: gains, _READ_WITH: record.read_with}
    return Telemetry(
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=record.delay_frames,
        mirror=None if record.delay_frames is None else record.mirror,
        measurements=np.where(record.measured[:, None], y, np.nan),
        commands=None if u is None else np.where(record.commanded[:, None], u, np.nan),
        diameter_m=record.diameter_m,
        obstruction=record.obstruction,
        imaging_wavelength_um=record.imaging_wavelength_um,
        metadata={name: text for name, text in stated.items() if text},
    )


def _modal_columns(seen: Telemetry, role: str, chosen: list[int], notes: list[str]) -> list[Column]:
    """Return the measurements or the commands of the chosen modes."""
    recorded_unit = seen.measurement_unit if role == "measurements" else seen.command_unit
    series, unit, said = getattr(seen, role), unit_name(recorded_unit), f"in {recorded_unit!r}"
    find, word = _MATRICES[role]
    if (matrix := find(seen)) is not None:
        series, said = series @ matrix.T, f"behind {word}"
        # the modes of our own telemetry are in nm
        unit = "nm" if unit or _FOREIGN not in seen.metadata else None
        notes.append(f"{role}: {word} times what was recorded")
    return [Column(name=f"mode {k} {said}", values=series[:, k], unit=unit) for k in chosen]


def _inverse_response(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from measurements to modes, None for the identity."""
    n, q, response = seen.modes, seen.measurements.shape[1], seen.modal_response
    if (response is None and q != n) or (response is not None and q > n > 2):
        raise ProblemError(
            f"this telemetry has {q} measurements and {n} modes: slopes without modal "
            "coefficients. Multiply them by the reconstructor of the loop.",
            in_python="As Telemetry(measurements=slopes @ R.T, slopes=slopes, reconstructor=R).",
        )
    if response is None or _is_gains(response, seen):
        return None
    if q < n or np.linalg.cond(response) > _CONDITION:
        raise ProblemError(
            f"the interaction matrix {response.shape} has no inverse: the {q} measurements do not "
            f"tell {n} modes apart. Give telemetry of tip and tilt alone."
        )
    return np.asarray(np.linalg.pinv(response), dtype=np.float64)


def _is_gains(response: FloatArray, seen: Telemetry) -> bool:
    """Whether a response is a gain for each mode; units of other programs are in their matrix."""
    if response.shape != (seen.modes, seen.modes):
        return False
    gains = np.diag(response)
    one = np.array_equal(response, np.eye(seen.modes))
    plain = np.array_equal(response, np.diag(gains)) and bool(np.all(gains > 0))
    return one or (plain and _FOREIGN not in seen.metadata)


def _influence(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from commands to modes, None for the identity."""
    n, m, influence = seen.modes, seen.n_commands, seen.influence_matrix
    if influence is None and m != n:
        raise ProblemError(
            f"this telemetry has {m} commands of {n} modes, and no influence matrix (modes, "
            "commands).",
            in_python="Give it to Telemetry(influence_matrix=...).",
        )
    is_identity = influence is None or np.array_equal(influence, np.eye(n))
    return None if is_identity else influence


_MATRICES = {  # from what was recorded to modes
    "measurements": (_inverse_response, "the inverse of the interaction matrix"),
    "commands": (_influence, "the influence matrix"),
}


def _join_commands(contents: Contents, path: Path) -> None:
    """Add the commands of another file, in place of those of the first."""
    other = read_contents(path)
    named = [column for column in other.columns if column.role == "commands"] or [
        column for column in other.columns if column.role in (None, "measurements")
    ]
    if not named:
        raise TelemetryError(f"{path} holds no commands.", path=path)
    named = _lay_beside(contents, other, named, path)
    if len(named) > 1 and any(column.axis is None for column in named):
        named = number_axes(named)
    columns = [column for column in contents.columns if column.role != "commands"]
    if not any(column.role in ("measurements", "open_loop") for column in columns):
        plain = number_axes([column for column in columns if column.role is None])
        columns = [column for column in columns if column.role is not None]
        columns += [replace(column, role="measurements") for column in plain]
    contents.columns = columns + [replace(column, role="commands") for column in named]
    # a unit is that of its own file
    contents.facts["command_unit"] = other.facts.pop("unit", {})
    for fact, places in other.facts.items():
        for where, value in places.items():
            contents.facts.setdefault(fact, {})[f"{where} in {path.name}"] = value
    contents.notes += [f"commands are from {path}", *other.notes]


def _lay_beside(
    contents: Contents, other: Contents, commands: list[Column], path: Path
) -> list[Column]:
    """Return the commands in the rows of the measurements, NaN where there are none.

    Rows are matched by the counters of both files, or else by their times. Without a common clock
    both files must have equally many rows.
    """
    sizes = [{len(column.values) for column in columns} for columns in (contents.columns, commands)]
    for role in CLOCKS:
        clocks = [c for file in (contents, other) for c in file.columns if c.role == role]
        if len(clocks) == 2 and [{len(clock.values)} for clock in clocks] == sizes:
            units = [seconds_per(clock.unit) if role == "times" else 1.0 for clock in clocks]
            one, two = (unit * clock.values for unit, clock in zip(units, clocks, strict=True))
            row = _match_rows(one, two, role, path)
            if not np.array_equal(row, np.arange(len(two))):
                contents.notes.append(
                    f"commands were laid beside the measurements by {clocks[1].name}: "
                    f"{int(np.sum(row >= 0))} of {len(row)} rows have one"
                )
            return [replace(c, values=np.where(row < 0, np.nan, c.values[row])) for c in commands]
    rows = sorted(set.union(*sizes))
    if len(rows) > 1:
        raise TelemetryError(
            f"{path} must have as many frames as the measurements; got "
            f"{', '.join(map(str, rows))}. Or give both files a counter of frames, or times.",
            path=path,
        )
    if any(column.role in CLOCKS for column in (*contents.columns, *other.columns)):
        contents.notes.append(
            "the files have no clock in common: rows of the same number were taken for one frame"
        )
    return commands


def _match_rows(one: FloatArray, other: FloatArray, role: str, path: Path) -> IntArray:
    """Return the row of the second clock for each row of the first, -1 where there is none."""
    steps = np.diff(one), np.diff(other)
    if np.array_equal(one, other) and np.all(steps[0] >= 0):
        return np.arange(len(one))
    if not (np.all(steps[0] >= 0) and np.all(steps[1] > 0)):  # no gap does
        raise TelemetryError(
            f"the {role} of both files must rise from row to row to be matched, without gaps.",
            path=path,
        )
    tolerance = _SAME_TIME * min(map(np.median, steps)) if role == "times" else 0.0
    row = np.searchsorted((other[1:] + other[:-1]) / 2, one, side="right")
    row = np.where(np.abs(other[row] - one) <= tolerance, row, -1)
    if np.mean(row >= 0) < 0.5:
        raise TelemetryError(
            f"only {int(np.sum(row >= 0))} of {len(one)} measurements have a command in {path} by "
            f"their {role}; they go from {one[0]:.12g} to {one[-1]:.12g} and from {other[0]:.12g} "
            f"to {other[-1]:.12g}. Give files of the same frames, or leave the {role} away in one "
            "of them if the rows do belong together.",
            path=path,
        )
    return row
