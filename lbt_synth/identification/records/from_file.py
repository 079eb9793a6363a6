"""Records from telemetry and from files of any origin."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from zipfile import ZipFile

import numpy as np

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.files import Telemetry, load_telemetry
from lbt_synth.identification.records.columns import Column, unit_name
from lbt_synth.identification.records.contents import (
    FITS,
    KINDS,
    Contents,
    choose_axes,
    name_in_errors,
    read_contents,
    select_series,
)
from lbt_synth.identification.records.from_series import build_record, join_commands
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import read_cards
from lbt_synth.storage.input_files import LARGEST_TEXT_BYTES, open_input
from lbt_synth.validation import FloatArray, choice, require_instance

_TELEMETRY_CARDS = ("LBTTELEM", "AOT-VERS")  # of this package, and of the AOT standard
_TELEMETRY_ARRAYS = {"META", "COMMANDS", "MEASURE"}


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
    frame_rate_hz, unit, command_unit : optional
        As for :func:`loop_record`, where the file does not tell them; a contradiction is refused.
        The unit of a spectrum is nm^2/Hz or nm/sqrt(Hz) and so on.
    delay_frames, diameter_m, obstruction, mirror : optional
        As for :func:`loop_record`; the delay also in place of that of the file.
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
    source = Path(path)
    if kind is not None:
        choice(kind, "kind", KINDS)
    given: dict[str, Any] = {
        "frame_rate_hz": frame_rate_hz,
        "delay_frames": delay_frames,
        "unit": unit,
        "command_unit": command_unit,
        "diameter_m": diameter_m,
        "obstruction": obstruction,
        "mirror": mirror,
        "source": str(source),
    }
    with name_in_errors(source):
        if is_telemetry(source):
            if kind not in (None, "closed_loop") or columns is not None or commands is not None:
                raise ProblemError(
                    "telemetry holds measurements and commands: kind must be closed_loop "
                    "or left out, and neither columns nor commands may be given. Choose its modes "
                    "with axes."
                )
            if averages is not None:
                raise ProblemError("averages are only for a spectrum; this file is telemetry.")
            return record_from_telemetry(load_telemetry(source), axes=axes, **given)
        contents = read_contents(source)
        if commands is not None:
            command_file = Path(commands)
            join_commands(contents, read_contents(command_file), command_file)
        kind, chosen = select_series(contents, kind=kind, axes=axes, columns=columns)
        return build_record(kind, chosen, contents, averages=averages, **given)


def is_telemetry(path: Path) -> bool:
    """Whether a file is telemetry of this package or of the AOT standard."""
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


_FACTS = ("frame_rate_hz", "delay_frames", "diameter_m", "obstruction")
_FOREIGN = "timing"  # key of metadata in telemetry of other programs
_CONDITION = 1e8


def record_from_telemetry(
    telemetry: Telemetry,
    *,
    axes: Sequence[int] | None = None,
    frame_rate_hz: float | None = None,
    delay_frames: float | None = None,
    mirror: PositionLoop | None = None,
    unit: str | None = None,
    command_unit: str | None = None,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    source: str | None = None,
) -> LoopRecord:
    """Make a record of tip and tilt from telemetry.

    Measurements become modes by the inverse of the interaction matrix, commands by the
    influence matrix, where there are such. A matrix of gains alone, one for each mode, is no
    mixture: these measurements stay as they were recorded, and the sensor gain of the record is
    what they show of a unit of phase.

    Parameters
    ----------
    telemetry : Telemetry
        What the loop recorded.
    axes : sequence of int, optional
        Tip and tilt among the modes, from 0; all, where there are one or two.
    frame_rate_hz, unit, command_unit : optional
        As for :func:`loop_record`, of modes, where the telemetry does not tell them; another
        frame rate is refused.
    delay_frames, diameter_m, obstruction, mirror : optional
        As for :func:`loop_record`, where they are not known, or in place of the telemetry's.
    source : str, optional
        Where it is from; by default the name of the system.

    Returns
    -------
    LoopRecord
        Series in nm, and the faults that were found.

    Raises
    ------
    ProblemError
        If it is not known which modes are tip and tilt, slopes come without a reconstructor, or a
        unit or rate is unknown or contradicted.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5)
    >>> shake = lbt.Truth(
    ...     turbulence=None,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=100),),
    ... )
    >>> run = lbt.simulate(lazy.controller, shake, hardware=path, frames=200)
    >>> seen = lbt.identification.record_from_telemetry(
    ...     lbt.files.telemetry_from_simulation(run, path)
    ... )
    >>> error = seen.pseudo_open_loop()[3:] - run.total_nm[0, 2:-1]  # no noise
    >>> bool(abs(error).max() < 1e-9)
    True
    """
    require_instance(telemetry, Telemetry)
    n = telemetry.modes
    chosen = choose_axes(axes, "axes", n, "modes")
    facts = {name: value for name in _FACTS if (value := getattr(telemetry, name)) is not None}
    contents = Contents(facts={name: {"the telemetry": value} for name, value in facts.items()})
    columns = {role: _modal_columns(telemetry, role, chosen, contents.notes) for role in _MATRICES}
    if telemetry.times_s is not None:
        columns["times"] = [Column(name="times_s", values=telemetry.times_s, unit="s")]
    if max(n, telemetry.measurements.shape[1], telemetry.commands.shape[1]) > len(chosen):
        contents.notes.append(f"axes are modes {', '.join(map(str, chosen))} of {n}")
    if _FOREIGN in telemetry.metadata:
        contents.notes.append(
            "of another program: that y(k) is of the exposure of frame k-1 is taken for granted"
        )
    record = build_record(
        "closed_loop",
        columns,
        contents,
        frame_rate_hz=frame_rate_hz,
        delay_frames=delay_frames,
        mirror=telemetry.mirror if mirror is None else mirror,
        unit=unit,
        command_unit=command_unit,
        diameter_m=diameter_m,
        obstruction=obstruction,
        source=(telemetry.name or "telemetry") if source is None else source,
    )
    return replace(cast(LoopRecord, record), imaging_wavelength_um=telemetry.imaging_wavelength_um)


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
    n, m, influence = seen.modes, seen.commands.shape[1], seen.influence_matrix
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
