"""The command telemetry, and how commands read a record: what its file does not say."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import command_options, input_files
from lbt_synth.cli.loop_inputs import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, load_telemetry, save_telemetry
from lbt_synth.files.telemetry.aot import lost_fields
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.files.telemetry.telemetry import FACTS, LAYERS
from lbt_synth.identification import LoopRecord, SpectrumRecord, load_record
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands
from lbt_synth.identification.records.from_file import is_telemetry, telemetry_of_record
from lbt_synth.loop import Imaging
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import fact, facts
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray

_FACTS = (  # that a file may not hold
    *("frame_rate_hz", "delay_frames", "unit", "command_unit", "diameter_m", "obstruction"),
    *("axes", "averages", "commands"),
)
_NOT_READING = ("loop", "show_unit", "output", "json", "verbose")  # of telemetry's options


def require_series(record: LoopRecord | SpectrumRecord, what: str) -> LoopRecord:
    """Return a record of series; refuse a spectrum, as ``what`` needs the series."""
    if isinstance(record, SpectrumRecord):
        raise ProblemError(
            f"{what} recorded series; got a spectrum. Try lbt-synth identify and lbt-synth design."
        )
    return record


def load_series(
    arguments: Namespace, axes: Sequence[int] | None = None
) -> LoopRecord | SpectrumRecord:
    """Load the record of the command line, or some of its axes, and show wavefronts in its unit."""
    facts = {name: getattr(arguments, name) for name in _FACTS}
    if axes is not None:
        chosen = facts["axes"]
        facts["axes"] = list(axes) if chosen is None else [chosen[axis] for axis in axes]
    record = load_record(
        arguments.file,
        columns=_parse_columns(arguments.columns),
        loop=arguments.loop,
        **facts,
    )
    choose_unit(arguments, record.diameter_m, record.shown_unit)
    repair = CommandRepair(
        increments=arguments.command_increments,
        shift_frames=arguments.command_shift_frames,
        swap_axes=arguments.swap_axes,
        sign=tuple(arguments.command_sign or ()),
        matrix=tuple(arguments.command_matrix or ()),
        scale=tuple(arguments.command_scale or ()),
    )
    if isinstance(record, SpectrumRecord):
        if repair.options:
            raise ProblemError(f"a spectrum has no commands; leave {repair.options} out.")
        return record
    return replace(
        repair_commands(record, repair) if repair.options else record,
        read_with=" ".join(filter(None, (record.read_with, repair.options))),
        stated_gain=tuple(arguments.sensor_gain or record.stated_gain),
    )


def record_imaging(arguments: Namespace, record: LoopRecord) -> Imaging:
    """Return the camera of the command line or the record, and the telescope of the record."""
    facts_of_record = record_telescope(arguments, record)
    return Imaging(**facts_of_record | {"obstruction": facts_of_record["obstruction"] or 0.0})


def record_telescope(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> dict[str, Any]:
    """Return diameter, obstruction and wavelength: of the command line, else of the record."""
    obstruction = getattr(record, "obstruction", arguments.obstruction)  # a spectrum has none
    wavelength_um = getattr(record, "imaging_wavelength_um", None)
    if arguments.wavelength_um is not None:
        wavelength_um = arguments.wavelength_um
    camera = Imaging() if wavelength_um is None else Imaging(wavelength_um=wavelength_um)
    return {
        "diameter_m": record.diameter_m,
        "obstruction": obstruction,
        "wavelength_um": camera.wavelength_um,
    }


def _parse_columns(pairs: Sequence[str] | None) -> dict[str, list[str | int]] | None:
    """Parse ROLE=NAME[,NAME] pairs; a role without a name has no column."""
    if pairs is None:
        return None
    out: dict[str, list[str | int]] = {}
    for pair in pairs:
        role, equals, names = pair.partition("=")
        if not equals or not role:
            raise ProblemError(
                "--columns takes ROLE=NAME or ROLE=NAME,NAME, as in measurements=tip,tilt or "
                f"density=3,4, and ROLE= for a role that no column has; got {pair!r}."
            )
        chosen = names.split(",") if names else []
        out[role] = [int(name) if name.isdecimal() else name for name in chosen]
    return out


def run_telemetry(arguments: Namespace) -> Report:
    """Show telemetry, or a record as telemetry, and write it."""
    output = arguments.output
    if output is not None:
        require_telemetry_name(output)
        require_writable(output, inputs=input_files(arguments))
    notes: list[str] = []
    anew = any(
        getattr(arguments, name) != usual
        for name, (_, usual) in command_options("telemetry").items()
        if name not in _NOT_READING
    )
    if is_telemetry(arguments.file) and not anew:
        telemetry = load_telemetry(arguments.file, loop=arguments.loop)
    else:
        record = require_series(load_series(arguments), "telemetry holds")
        telemetry = telemetry_of_record(record)
        notes = [f"note: {note}" for note in (record.summary(), *record.notes)]
    choose_unit(arguments, telemetry.diameter_m, telemetry.shown_unit)
    report = _describe_telemetry(telemetry)
    report.data["file"] = arguments.file
    report.notes += notes
    if "aot_loops" in telemetry.metadata:
        taken, loops = (telemetry.metadata[key] for key in ("aot_loop", "aot_loops"))
        report.notes.append(f"note: {taken} is one of the control loops {loops}; see --loop")
    if "timing" not in telemetry.metadata:  # of another program
        report.notes.append(telemetry.convention)
    if output is not None:
        write_telemetry(report, output, telemetry)
    return report


def write_telemetry(report: Report, output: str, telemetry: Telemetry) -> None:
    """Write telemetry with the unit that is shown; note the file and what its format leaves out."""
    telemetry = replace(telemetry, shown_unit=shown_unit("nm")[0])
    report.note_written(save_telemetry(output, telemetry))
    lost = lost_fields(telemetry) if require_telemetry_name(output) == "aot" else ()
    report.data["lost"] = list(lost)
    if lost:
        report.notes.append(f"note: the AOT standard has no place for {', '.join(lost)}.")


def _describe_telemetry(telemetry: Telemetry) -> Report:
    """Describe the arrays in a telemetry file, and the loop that they are from."""
    arrays = [
        (layer.field, getattr(telemetry, layer.field), layer)
        for layer in LAYERS.values()
        if getattr(telemetry, layer.field) is not None
    ]
    rms = {
        name: _rms(array) for name, array, layer in arrays if layer.is_series and name != "times_s"
    }
    units = {name: layer.unit_in(telemetry) for name, _, layer in arrays}
    mirror = None if telemetry.mirror is None else asdict(telemetry.mirror)
    report = Report(
        data={
            "frames": telemetry.frames,
            "modes": telemetry.modes,
            "arrays": {name: list(array.shape) for name, array, _ in arrays},
            "units": units,
            "rms": rms,
            "metadata": dict(telemetry.metadata),
            "mirror": mirror,
            "mirror_taps": telemetry.mirror_taps,
            "convention": telemetry.convention,
        }
    )
    seconds = telemetry.frames / telemetry.frame_rate_hz
    report.verdict.append(
        f"A loop of {count_text(telemetry.modes, 'mode')} at {telemetry.frame_rate_hz:g} Hz, for "
        f"{seconds:.6g} s ({telemetry.frames} frames)."
    )
    rows = list[tuple[str | float, ...]]()
    for name, array, layer in arrays:
        shape, (unit, factor) = " x ".join(map(str, array.shape)), shown_unit(units[name])
        rows.append((name, shape, layer.axes, unit, factor * rms.get(name, np.nan)))
    report.add_table("What the file holds", ("array", "shape", "axes", "unit", "rms"), rows)
    loop = {
        name: fact(getattr(telemetry, name), text, unit=unit)
        for name, (_, unit, text) in FACTS.items()
        if not name.endswith("_unit")
    }
    report.add_facts("Loop", facts(**loop))
    more = {f"mirror, {name}": value for name, value in (mirror or {}).items()}
    more |= telemetry.metadata
    if more:
        report.add_table("What else the file says", ("name", "value"), more.items())
    return report


def _rms(series: FloatArray) -> float:
    """Return the root of the mean over frames of the sum of squares over columns."""
    return float(np.sqrt(np.sum(np.nanmean(series**2, axis=0))))
