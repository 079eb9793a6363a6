"""Records from files of any origin, by what the file tells and what the call gives."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

from lbt_synth.errors import ProblemError
from lbt_synth.files import load_telemetry
from lbt_synth.identification.records.column_selection import KINDS, select_series
from lbt_synth.identification.records.commands_file import join_commands
from lbt_synth.identification.records.contents import FITS, name_in_errors, read_contents
from lbt_synth.identification.records.from_series import build_record
from lbt_synth.identification.records.from_telemetry import record_from_telemetry
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.spectrum import SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import LONGEST_HEADER, has_card
from lbt_synth.validation import choice

_TELEMETRY_CARDS = ("LBTTELEM", "AOT-VERS")  # of our own telemetry, and of the AOT standard
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
        if _is_telemetry(source):
            if kind not in (None, "closed_loop") or columns is not None or commands is not None:
                raise ProblemError(
                    "telemetry holds measurements and commands: kind must be closed_loop, and "
                    "neither columns nor commands be given. Choose its modes by axes."
                )
            if averages is not None:
                raise ProblemError("this is telemetry, and averages are of a spectrum.")
            return record_from_telemetry(load_telemetry(source), modes=axes, **given)
        contents = read_contents(source)
        if commands is not None:
            other = Path(commands)
            join_commands(contents, read_contents(other), other)
        series = select_series(contents, kind=kind, axes=axes, columns=columns)
        return build_record(series, contents, averages=averages, **given)


def _is_telemetry(path: Path) -> bool:
    try:
        if path.suffix.lower() in FITS:
            with path.open("rb") as stream:
                header = stream.read(LONGEST_HEADER)
            return any(has_card(header, card) for card in _TELEMETRY_CARDS)
        names = ZipFile(path).namelist() if path.suffix.lower() == ".npz" else []
    except (BadZipFile, OSError, ValueError):
        return False  # read_contents says so
    return {Path(name).stem for name in names} >= _TELEMETRY_ARRAYS
