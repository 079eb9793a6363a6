"""What identify and auto read, print and write: the record, what is known, and the model."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lbt_synth.cli.arguments import given_options, option_name
from lbt_synth.cli.output import Report
from lbt_synth.config import identified_config
from lbt_synth.config.write import RAISED, config_text, require_writable_facts
from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.files import save_gain
from lbt_synth.identification import (
    IdentifiedAxis,
    IdentifiedModel,
    LoopRecord,
    SpectrumRecord,
    load_record,
)
from lbt_synth.identification.accelerometers.readings import Readings, load_readings
from lbt_synth.identification.accelerometers.transfers import AccelerometerTransfers
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands
from lbt_synth.identification.commands.verdict import explain_commands
from lbt_synth.identification.fit.identified_model import axis_names, model_tables
from lbt_synth.identification.records.contents import TEXTS, join_names, read_contents
from lbt_synth.identification.records.record import LEAST_SECONDS, require_length
from lbt_synth.loop import Imaging
from lbt_synth.report.draw import require_figure_name, save_figure
from lbt_synth.report.figures import identification_figure
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_atomically
from lbt_synth.storage.rows import row_table
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, number

if TYPE_CHECKING:  # it loads the methods of synthesis, which identify does not need
    from lbt_synth.identification.auto import RecordedDesign

_FACTS = (  # that a file may not hold
    *("delay_frames", "unit", "command_unit", "diameter_m", "obstruction"),
    *("axes", "averages", "commands"),
)
_READING = (  # options that say how a record is read
    *_FACTS,
    *("kind", "frame_rate_hz", "columns", "sensor_gain", "command_increments", "swap_axes"),
    *("command_shift_frames", "command_sign", "command_matrix", "command_scale"),
)


def read_record(
    arguments: Namespace, least_seconds: float = LEAST_SECONDS
) -> LoopRecord | SpectrumRecord:
    """Load the record of the command line, with its short gaps bridged; refuse a short one."""
    record = load_series(arguments)
    if isinstance(record, LoopRecord):
        record = record.bridged()
        require_length(record, seconds=least_seconds)
    return record


def require_series(record: LoopRecord | SpectrumRecord, what: str) -> LoopRecord:
    """Return a record of series; refuse a spectrum, as ``what`` needs the series."""
    if isinstance(record, SpectrumRecord):
        raise ProblemError(
            f"{what} recorded series; got a spectrum. Try lbt-synth identify and lbt-synth design."
        )
    return record


def is_read_anew(arguments: Namespace) -> bool:
    """Return whether the command line says anything about how a record is read."""
    return any(getattr(arguments, name) not in (None, False, 0) for name in _READING)


def load_series(
    arguments: Namespace, axes: Sequence[int] | None = None
) -> LoopRecord | SpectrumRecord:
    """Load the record of the command line, or some of its axes, whatever its length."""
    kind, facts = arguments.kind, {name: getattr(arguments, name) for name in _FACTS}
    if axes is not None:
        chosen = facts["axes"]
        facts["axes"] = list(axes) if chosen is None else [chosen[axis] for axis in axes]
    record = load_record(
        arguments.file,
        kind=None if kind is None else kind.replace("-", "_"),
        frame_rate_hz=None if kind == "spectrum" else arguments.frame_rate_hz,
        columns=_parse_columns(arguments.columns),
        **facts,
    )
    repair = CommandRepair(
        increments=arguments.command_increments,
        shift_frames=arguments.command_shift_frames,
        swap_axes=arguments.swap_axes,
        sign=tuple(arguments.command_sign or ()),
        matrix=tuple(arguments.command_matrix or ()),
        scale=arguments.command_scale or 1.0,
    )
    if isinstance(record, SpectrumRecord):
        if repair.options:
            raise ProblemError(f"a spectrum has no commands; leave {repair.options} out.")
        return record
    options = repair.options
    if arguments.command_scale is not None and not repair.scales:
        options = f"{options} --command-scale 1".strip()
    return replace(
        repair_commands(record, repair) if repair.options else record,
        read_with=" ".join(filter(None, (record.read_with, options))),
        stated_gain=tuple(arguments.sensor_gain or record.stated_gain),
    )


def is_scale_known(record: LoopRecord) -> bool:
    """Return whether somebody said at which size commands were recorded."""
    return "--command-scale" in record.read_with or "--command-matrix" in record.read_with


def judge_record(arguments: Namespace, record: LoopRecord) -> tuple[str, ...]:
    """Refuse a record whose commands do not reach its measurements; return notes on others."""
    if record.commands is None:
        return ()
    verdict = explain_commands(record, sensor_gain=record.stated_gain or None)
    if not arguments.accept_record:
        verdict.require_accepted()
    return (*verdict.notes, *(f"warning: it is assumed that {word}" for word in verdict.overruled))


def with_repair(record: LoopRecord, made: RecordedDesign) -> RecordedDesign:
    """Return what was made of a record, with the repair of its commands as an assumption."""
    if not record.read_with:
        return made
    words = f"the commands of the record were read with {record.read_with}"
    design = replace(made.design, assumptions=(words, *made.design.assumptions))
    return replace(made, design=design)


def record_imaging(arguments: Namespace, record: LoopRecord) -> Imaging:
    """Return the camera of the command line or the record, and the telescope of the record."""
    return Imaging(
        diameter_m=record.diameter_m,
        obstruction=0.0 if record.obstruction is None else record.obstruction,
        wavelength_um=imaging_wavelength_um(arguments, record),
    )


def imaging_wavelength_um(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> float:
    """Return the wavelength of Strehl ratios: of the command line, else of the record [um]."""
    known = record.imaging_wavelength_um if isinstance(record, LoopRecord) else None
    for value in (arguments.wavelength_um, known):
        if value is not None:
            return Imaging(wavelength_um=value).wavelength_um
    return Imaging().wavelength_um


def _parse_columns(given: Sequence[str] | None) -> dict[str, list[str | int]] | None:
    """Parse ROLE=NAME[,NAME] pairs; a role without a name has no column."""
    if given is None:
        return None
    out: dict[str, list[str | int]] = {}
    for pair in given:
        role, equals, names = pair.partition("=")
        if not equals or not role:
            raise ProblemError(
                "--columns takes ROLE=NAME or ROLE=NAME,NAME, as in measurements=tip,tilt or "
                f"density=3,4, and ROLE= for a role that no column has; got {pair!r}."
            )
        chosen = names.split(",") if names else []
        out[role] = [int(name) if name.isdecimal() else name for name in chosen]
    return out


def identification_options(
    arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> dict[str, Any]:
    """Return the options of an identification that the command line gives.

    Refuse facts of which no model can be written before it is identified.
    """
    obstruction = record.obstruction if isinstance(record, LoopRecord) else arguments.obstruction
    if obstruction is not None and record.diameter_m is None:
        raise ProblemError("--obstruction is a fraction of the diameter; give --diameter-m.")
    loop = record if isinstance(record, LoopRecord) else arguments
    require_writable_facts(
        record.axes,
        loop.frame_rate_hz,
        loop.delay_frames,
        diameter_m=record.diameter_m,
        obstruction=obstruction,
        wavelength_um=imaging_wavelength_um(arguments, record),
    )
    options: dict[str, Any] = {
        "announced": _expected_lines(arguments),
        "lowest_line_hz": arguments.lowest_line_hz,
        "most_lines": arguments.most_lines,
    }
    if isinstance(record, SpectrumRecord):
        if arguments.sensor_gain is not None:
            raise ProblemError("a spectrum is of the phase: it has no sensor gain to be given.")
        return options | {"noise_nm": arguments.noise_nm}
    if arguments.noise_nm is not None:
        raise ProblemError("--noise-nm is for spectra; the noise of a series is found in it.")
    return options | {"sensor_gain": record.stated_gain or None}


def _expected_lines(arguments: Namespace) -> FloatArray:
    """Return lines known beforehand and their errors, (lines, 2) [Hz], by arguments and a file."""
    lines = []
    if arguments.lines_hz is not None:
        error = number(arguments.lines_error_hz, "lines_error_hz", at_least=0)
        lines = [(number(line, "lines_hz", above=0), error) for line in arguments.lines_hz]
    if arguments.lines_file is not None:
        path = require_ending(arguments.lines_file, "a list of lines", TEXTS, TelemetryError)
        columns = read_contents(path).columns
        # headings, if there are any, must say which column has the frequencies
        columns.sort(key=lambda column: bool(column.name) and column.role != "frequency")
        roles = [column.role == "frequency" for column in columns if column.name]
        table = np.column_stack([column.values for column in columns])
        if table.shape[1] > 2 or sum(roles) != bool(roles) or np.isnan(table[:, 0]).any():
            raise ProblemError(
                f"{path} must have a frequency_hz in each row, and no more than an error_hz beside "
                f"it; got {join_names(columns)}."
            )
        lines += [(row[0], np.nansum(row[1:])) for row in table]
    return np.reshape(lines, (-1, 2))


def require_comparable(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> None:
    """Refuse accelerometers beside a spectrum, and what is said of none."""
    if arguments.accelerometers is None:
        for option in given_options(arguments, "accelerometer_rate_hz", "acceleration_unit"):
            raise ProblemError(f"{option_name(option)} goes with --accelerometers.")
    elif isinstance(record, SpectrumRecord):
        raise ProblemError("accelerometers are compared with the recorded series; got a spectrum.")


def read_accelerations(arguments: Namespace, record: LoopRecord) -> Readings:
    """Read the accelerometers of the command line."""
    return load_readings(
        arguments.accelerometers,
        record.frame_rate_hz,
        rate_hz=arguments.accelerometer_rate_hz,
        unit=arguments.acceleration_unit,
    )


def add_accelerometers(report: Report, found: AccelerometerTransfers) -> None:
    """Add how the channels of accelerometers move with the lines, and what is used."""
    if found.transfers:
        report.add_rows("accelerometer_lines", "Accelerometers and lines", found.transfers)
    report.add_rows("accelerometers", "Accelerometers", found.channels)
    report.data["accelerometer_shift"] = {
        name: getattr(found, f"shift_{name}") for name in ("frames", "error_frames")
    }
    report.notes.append(f"note: {found.shift_text}")


def find_places(arguments: Namespace, model: str | Path | None, **others: Path) -> dict[str, Path]:
    """Return where model, figure and others go, by default beside each other.

    Refuse bad places.
    """
    output = Path(arguments.output)
    model = require_ending(model or output.with_suffix(".yaml"), "a model", (".yaml", ".yml"))
    places = {**others, "model": model}
    if not arguments.no_figure:
        figure = arguments.figure or output.with_suffix(".png")
        places["figure"] = require_figure_name(figure)
    elif arguments.figure is not None:
        raise ProblemError("give one of --figure and --no-figure, not both.")
    read = ("file", "commands", "lines_file", "accelerometers")
    given = given_options(arguments, *(name for name in read if name in arguments))
    require_writable(*places.values(), inputs=given.values())
    return places


def write_files(
    report: Report,
    places: dict[str, Path],
    arguments: Namespace,
    record: LoopRecord | SpectrumRecord,
    model: IdentifiedModel,
    made: RecordedDesign | None = None,
    accelerometers: AccelerometerTransfers | None = None,
) -> None:
    """Write gain file, model and figure, one after the other: what is ready is not lost."""
    designs = None
    if made is not None:
        designs = {made.name: made.design}
        report.note_written(save_gain(places["gain"], made.design))
    try:
        text, comments = _model_text(model, arguments, record, accelerometers)
    except ProblemError as error:
        if accelerometers is None:
            raise
        report.notes.append(f"warning: the model is written without accelerometers: {error}")
        text, comments = _model_text(model, arguments, record, None)
    report.note_written(write_atomically(places["model"], text), "model")
    report.notes += [f"note: {key} is {why}." for key, why in comments.items() if RAISED in why]
    if "figure" in places:
        figure = identification_figure(model, designs=designs)
        report.note_written(save_figure(figure, places["figure"]), "figure")


def _model_text(
    model: IdentifiedModel,
    arguments: Namespace,
    record: LoopRecord | SpectrumRecord,
    accelerometers: AccelerometerTransfers | None,
) -> tuple[bytes, dict[str, str]]:
    """Return the text of a configuration for an identified model, and its comments."""
    obstruction = record.obstruction if isinstance(record, LoopRecord) else arguments.obstruction
    source = ascii(Path(arguments.file).name)[1:-1]
    settings, comments = identified_config(
        model,
        diameter_m=record.diameter_m,
        obstruction=obstruction,
        wavelength_um=imaging_wavelength_um(arguments, record),
        title=f"Identified from {source} by lbt-synth {arguments.command}.",
        accelerometers=accelerometers,
    )
    return config_text(settings, comments).encode(), comments


def add_record(report: Report, record: LoopRecord | SpectrumRecord) -> None:
    """Add what a record holds, and what was found wrong with it."""
    if isinstance(record, SpectrumRecord):
        _add_spectra(report, record)
    else:
        _add_series(report, record)


def _add_spectra(report: Report, record: SpectrumRecord) -> None:
    f = record.frequency_hz
    report.data["record"] = {"kind": "spectrum", "frequencies": f.size, "notes": record.notes}
    report.add_table(
        f"Spectra of {count_text(record.axes, 'axis', 'axes')}",
        ("axis", "from [Hz]", "to [Hz]", "rms [nm]"),
        [
            (name, f[0], f[-1], f"{rms:.1f}")
            for name, rms in zip(axis_names(record.axes), record.rms_nm, strict=True)
        ],
    )
    report.notes += [f"note: {note}" for note in record.notes]


def _add_series(report: Report, record: LoopRecord) -> None:
    health = record.health
    report.data["record"] = record_data(record)
    axes = count_text(record.axes, "axis", "axes")
    text = f"{record.duration_s:.4g} s, {_loop_kind(record)}, {axes}"
    if health.findings:
        caption = f"Record: {text}: {health.summary()}"
        report.tables.append(row_table(caption, health.findings))
    else:
        report.notes.append(f"record: {text}; {health.summary()}")
    report.notes += [f"note: {note}" for note in health.notes]


def record_data(record: LoopRecord) -> dict[str, Any]:
    """Return what JSON says of a record."""
    health = record.health
    return {
        "kind": _loop_kind(record),
        "frames": record.frames,
        "usable": health.usable,
        "frame_rate_hz": record.frame_rate_hz,
        "delay_frames": record.delay_frames,
        "findings": [asdict(found) for found in health.findings],
        "notes": health.notes,
    }


def _loop_kind(record: LoopRecord) -> str:
    return "open loop" if record.commands is None else "closed loop"


def add_model(report: Report, model: IdentifiedModel) -> None:
    """Add the tables of an identified model, its notes, and its numbers."""
    named_axes = list(zip(axis_names(len(model.axes)), model.axes, strict=True))
    report.tables += model_tables(model)
    if not model.parts:
        report.notes.append("no vibration stands out of the turbulence and the noise.")
    report.notes += [marked_note(note) for note in model.notes]
    for name, axis in named_axes:
        where = "" if name == "-" else f"{name}: "
        report.notes.append(f"{where}sensor gain {axis.sensor_gain_note}.")
        report.notes.append(f"{where}{_whiteness_note(axis)}")
    report.data["axes"] = [_axis_record(axis) for axis in model.axes]
    report.data["vibrations"] = [asdict(line) for line in model.parts]
    report.data["model_notes"] = model.notes


def marked_note(note: str) -> str:
    """Mark a note as such, unless it is a warning."""
    return note if note.startswith("warning") else f"note: {note}"


def _whiteness_note(axis: IdentifiedAxis) -> str:
    test = axis.whiteness
    if test.white:
        return f"innovations are white (p = {test.p_value:.2g})."
    return (
        f"innovations are not white: their cumulative power is off by up to "
        f"{100 * test.deviation:.2g} % (p = {test.p_value:.1g}). The model leaves something out; "
        "see the figure."
    )


def _axis_record(axis: IdentifiedAxis) -> dict[str, Any]:
    turbulence, whiteness = axis.turbulence, axis.whiteness
    tests = ("deviation", "p_value", "white")
    noise = ("noise_nm", "noise_error_nm", "noise_correlation", "noise_correlation_error")
    own = (*noise, "sensor_gain", "sensor_gain_error", "sensor_gain_note")
    return {
        "turbulence": asdict(axis.turbulence_fit)
        | {"coefficients": turbulence.coefficients, "driving_rms_nm": turbulence.driving_rms_nm},
        "vibrations": [asdict(line) for line in axis.parts],
        **{name: getattr(axis, name) for name in own},
        "whiteness": {name: getattr(whiteness, name) for name in tests},
    }
