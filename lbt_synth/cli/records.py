"""The commands identify, auto and diagnose: from a record to a model, a design, an autopsy."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lbt_synth import identification, studies
from lbt_synth.cli.arguments import input_files, refuse_options
from lbt_synth.cli.loop_inputs import add_certificate, keep_unit, load_designs, say_accelerometers
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import count_progress, printable
from lbt_synth.cli.telemetry import load_series, record_imaging, record_telescope, require_series
from lbt_synth.config.write import RAISED, config_text, identified_config, require_writable_facts
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.identification import IdentifiedModel, LoopRecord, SpectrumRecord
from lbt_synth.identification.accelerometers.readings import Readings, load_readings
from lbt_synth.identification.accelerometers.transfers import (
    AccelerometerTransfers,
    accelerometer_transfers,
)
from lbt_synth.identification.commands.verdict import explain_commands
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, model_tables, say_count
from lbt_synth.identification.records.record import require_length
from lbt_synth.loop import Imaging, loop_margins
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures import identification_figure
from lbt_synth.report.page.html import require_page_names, write_page
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_atomically
from lbt_synth.storage.display_unit import nm_text, shown_unit
from lbt_synth.storage.rows import fact, facts, row_table
from lbt_synth.storage.words import count_text

if TYPE_CHECKING:  # they load the methods of synthesis, which identify does not need
    from lbt_synth.design import Design
    from lbt_synth.identification.auto import RecordedDesign
    from lbt_synth.identification.prediction.comparison import PredictionRow


_STEPS = 3  # that diagnose and auto count
_EXAMINES, _TESTED = "diagnose examines", "auto tests its design on"  # recorded series


def run_identify(arguments: Namespace) -> Report:
    """Identify a loop from its record; write a configuration and, by default, a figure."""
    places = find_places(arguments)
    record = load_series(arguments)
    if isinstance(record, LoopRecord):
        record = record.bridged()
        require_length(record)
    readings = read_accelerations(arguments, record)
    options = identification_options(arguments, record)
    doubts = judge_record(arguments, record)
    model = identification.identify(record, **options)
    report = Report(data={"source": str(arguments.file)})
    add_model(report, model)
    add_record(report, record)
    _say_model(report, model, record)
    transfers: AccelerometerTransfers | None = None
    if readings is not None and isinstance(record, LoopRecord):
        channels, values, notes = readings
        report.notes += [f"note: {note}." for note in notes]
        try:
            transfers = accelerometer_transfers(model, record, values, channels=channels)
        except LbtSynthError as error:  # the model is not lost
            report.notes.append(f"warning: the accelerometers were not compared: {error}")
        else:
            add_accelerometers(report, transfers)
    report.notes += [marked_note(doubt) for doubt in doubts]
    write_files(report, places, arguments, record, model, accelerometers=transfers)
    return report


def _say_model(report: Report, model: IdentifiedModel, record: LoopRecord | SpectrumRecord) -> None:
    """Begin with the strongest vibrations, and whether the model is enough."""
    if isinstance(record, LoopRecord) and record.findings:
        report.notes.insert(0, f"note: {record.summary()}")
    white = all(axis.whiteness.white for axis in model.axes)
    leaves = "is white: the model is enough" if white else "is not white: the model lacks something"
    said = "No vibration stands out of the turbulence and the noise."
    if lines := [part for part in model.parts if part.kind != "turbulence"]:
        strongest = max(lines, key=lambda line: line.rms_nm)
        said = (
            f"{count_text(len(lines), 'vibration')}, the strongest of "
            f"{nm_text(strongest.rms_nm, '.1f')} rms at {strongest.frequency_hz:.2f} Hz."
        )
    report.verdict += [said, say_count(model), f"What the model does not explain {leaves}."]


def run_auto(arguments: Namespace) -> Report:
    """Identify a loop, design its controller, test it on unseen data, write its gain file."""
    gain, arguments.file = require_gain_name(arguments.output), arguments.files[0]
    if len(arguments.files) > 1:
        return _run_nights(arguments, gain)
    places = find_places(arguments, gain=gain)
    record = require_series(load_series(arguments), _TESTED).bridged()
    channels, values, notes = read_accelerations(arguments, record) or (None, None, ())
    imaging = record_imaging(arguments, record)
    with count_progress(total=_STEPS, what="identifying and designing") as count:
        made = identification.design_from_record(
            record,
            method=arguments.method,
            imaging=imaging,
            accept_record=arguments.accept_record,
            command_scale_known=_knows_scale(record),
            separate_axes=arguments.separate_axes,
            accelerations=values,
            channels=channels,
            progress=count,
            **identification_options(arguments, record),
        )
    made = replace(made, design=_with_repairs(made.design, record))
    design, table = made.design, made.held_out
    report = Report(data={"source": str(arguments.file), "method": design.method})
    report.add_rows(
        "held_out",
        f"Residual on the second half of the record, by models of the first; {imaging.label}",
        list(table.entries),
    )
    report.notes += [f"note: {note}" for note in table.notes]
    _say_held_out(report, made, record, imaging)
    add_record(report, record)
    add_model(report, made.model)
    report.notes += [f"note: {note}." for note in notes]
    if made.channels:
        title = "Accelerometers: residual on the second half of the record"
        report.add_rows("accelerometers", title, list(made.channels))
    loop = design.close(made.model.hardware)
    add_certificate(report, design)
    report.verdict.append(f"The loop has a modulus margin of {loop_margins(loop).modulus:.3f}.")
    write_files(report, places, arguments, record, made.model, designs={made.name: design})
    return report


def _knows_scale(record: LoopRecord) -> bool:
    """Whether the commands were read at a size that the user gave."""
    return any(option in record.read_with for option in ("--command-scale", "--command-matrix"))


def _run_nights(arguments: Namespace, gain: Path) -> Report:
    """Design for several nights at once, and compare with the designs of each."""
    of_one = ["accelerometers", "accelerometer_rate_hz", "acceleration_unit", "commands"]
    refuse_options(arguments, [*of_one, "noise_nm", "wavelength_um"], "is for one record")
    names = [printable(Path(path).name) for path in arguments.files]
    if len(set(names)) != len(names):
        raise ProblemError(f"each record must have a name of its own; got {', '.join(names)}.")
    require_writable(gain, inputs=input_files(arguments))
    nights = dict[str, LoopRecord]()
    for name, path in zip(names, arguments.files, strict=True):
        series = load_series(Namespace(**vars(arguments) | {"file": path}))
        nights[name] = require_series(series, _TESTED).bridged()
    with count_progress(total=_STEPS * len(names), what="identifying and designing") as count:
        made = studies.design_from_nights(
            nights,
            method=arguments.method,
            progress=count,
            accept_record=arguments.accept_record,
            command_scale_known=all(map(_knows_scale, nights.values())),
            separate_axes=arguments.separate_axes,
            lowest_line_hz=arguments.lowest_line_hz,
            most_lines=arguments.most_lines,
        )
    design = _with_repairs(made.design, *nights.values())
    report = Report(
        data={"sources": arguments.files, "written": made.name, "method": design.method},
        verdict=list(made.verdict),
        notes=[marked_note(note) for note in made.notes],
    )
    words = {"unit": "nm", "format": ".1f", "missing": "unstable"}
    rows = [
        facts(
            design=fact(name, "design of"),
            **{night: fact(nm, night, **words) for night, nm in residual_nm.items()},
            worst_ratio=fact(made.worst(name)[0], "variance / own, at worst", format=".3f"),
        )
        for name, residual_nm in made.residual_nm.items()
    ]
    report.add_rows("nights", "Residual by the model of each night", rows)
    add_certificate(report, design)
    report.note_written(save_gain(gain, keep_unit(design, nights[names[-1]].diameter_m)))
    return report


def _say_held_out(
    report: Report, made: RecordedDesign, record: LoopRecord, imaging: Imaging
) -> None:
    """Begin with what the second half of the data says of a design from the first."""
    from lbt_synth.identification.prediction.comparison import RAN

    best, name = made.held_out[made.name], made.name
    report.data |= {"gain_over_what_ran": None, "wavelength_um": imaging.wavelength_um}
    said = f"The {name} leaves {_rms_text(best, ' rms')} on unseen data"
    if record.commands is not None:
        ran = made.held_out[RAN]
        said += f", where what ran left {_rms_text(ran)}"
        if ran.strehl >= 0 and best.strehl >= 0:
            said += f"; {imaging.label} (tip and tilt) {ran.strehl:.3f} -> {best.strehl:.3f}"
        report.data["gain_over_what_ran"] = {
            "residual_nm": [ran.replayed_nm, best.replayed_nm],
            "strehl": [ran.strehl, best.strehl],
        }
    report.verdict.append(f"{said}.")
    if bought := say_accelerometers(made.design):
        report.verdict.append(f"That is {bought}.")
    if best.contradicts_model:
        more = "more" if best.deviations > 0 else "less"
        report.notes.append(
            f"warning: on unseen data the {name} leaves {more} than the model expects, by "
            f"{abs(best.deviations):.1f} standard errors: the disturbance changed, or the model "
            "leaves something out."
        )
    report.notes += [marked_note(note) for note in made.notes]


def _rms_text(row: PredictionRow, unit: str = "") -> str:
    """Return the residual of a row on the data, or its bound where the noise hides it."""
    if row.replayed is not None and row.replayed.hidden:
        return row.replayed.text
    return nm_text(row.replayed_nm, ".1f") + unit


def run_diagnose(arguments: Namespace) -> Report:
    """Diagnose a record, with a design to try on it if one is given, and write the page."""
    from lbt_synth.identification.diagnosis import (  # with it come the methods
        disturbance_lines,
        judge_channels,
        live_axes,
    )
    from lbt_synth.report.pages import diagnosis_page, diagnosis_rows, say_diagnosis

    if arguments.output is not None:
        require_page_names(arguments.output, arguments.pdf, inputs=input_files(arguments))
    elif arguments.pdf is not None:
        raise ProblemError("--pdf is the page of -o on paper; give -o, too.")
    designs = {} if arguments.gain is None else load_designs([arguments.gain])
    both = require_series(load_series(arguments), _EXAMINES)
    live = live_axes(both)
    some = len(live) not in (0, both.axes)
    record = require_series(load_series(arguments, live), _EXAMINES) if some else both
    with count_progress(total=_STEPS, what="diagnosing") as count:
        diagnosis = identification.diagnose(
            record.bridged(),
            given=designs,
            imaging=record_imaging(arguments, record),
            progress=count,
            **identification_options(arguments, record),
        )
    if record.axes < both.axes:
        said = "the rest is of the axis that lives: the other one is dead"
        notes = (said, *diagnosis.notes)
        diagnosis = replace(diagnosis, channels=judge_channels(both), notes=notes)
    model = diagnosis.model
    report = Report(
        data={
            "source": str(arguments.file),
            "doubt": diagnosis.doubt or None,
            "record": record_data(record),
            "lines": [] if model is None else [asdict(x) for x in disturbance_lines(model)],
            "best": diagnosis.best or None,
            "notes": diagnosis.notes,
        },
        verdict=say_diagnosis(diagnosis, designs),
        notes=[marked_note(note) for note in diagnosis.notes],
    )
    for _, key, caption, rows in diagnosis_rows(diagnosis):
        report.add_rows(key, caption, rows)
    report.tables += [] if model is None else model_tables(model)[1:]
    if arguments.output is not None:
        page = diagnosis_page(diagnosis, input_files(arguments))
        report.note_written(*write_page(page, arguments.output, pdf=arguments.pdf))
    return report


def judge_record(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> tuple[str, ...]:
    """Refuse a record whose commands do not reach its measurements; return notes on others."""
    if isinstance(record, SpectrumRecord) or record.commands is None:
        return ()
    verdict = explain_commands(record, sensor_gain=record.stated_gain or None)
    if not arguments.accept_record:
        verdict.require_accepted()
    return (*verdict.notes, *(f"warning: it is assumed that {word}" for word in verdict.overruled))


def identification_options(
    arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> dict[str, Any]:
    """Return the options of an identification that the command line gives.

    Refuse facts of which no model can be written before it is identified.
    """
    telescope = record_telescope(arguments, record)
    if telescope["obstruction"] is not None and record.diameter_m is None:
        raise ProblemError("--obstruction is a fraction of the diameter; give --diameter-m.")
    loop = record if isinstance(record, LoopRecord) else arguments  # a spectrum has no timing
    timing = {name: getattr(loop, name) for name in ("frame_rate_hz", "delay_frames")}
    require_writable_facts(record.axes, **timing, **telescope)
    options: dict[str, Any] = {
        "lowest_line_hz": arguments.lowest_line_hz,
        "most_lines": arguments.most_lines,
    }
    if isinstance(record, SpectrumRecord):
        if arguments.sensor_gain is not None:
            raise ProblemError("a spectrum is of the phase: it has no sensor gain to be given.")
        return options | timing | {"noise_nm": arguments.noise_nm}
    if arguments.noise_nm is not None:
        raise ProblemError("--noise-nm is for spectra; the noise of a series is found in it.")
    return options | {"sensor_gain": record.stated_gain or None}


def read_accelerations(
    arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> Readings | None:
    """Read the accelerometers of the command line, if there are any."""
    if arguments.accelerometers is None:
        of_others = ("accelerometer_rate_hz", "acceleration_unit")
        refuse_options(arguments, of_others, "goes with --accelerometers")
        return None
    record = require_series(record, "accelerometers are compared with")
    return load_readings(
        arguments.accelerometers,
        record.frame_rate_hz,
        rate_hz=arguments.accelerometer_rate_hz,
        unit=arguments.acceleration_unit,
    )


def add_accelerometers(report: Report, transfers: AccelerometerTransfers) -> None:
    """Add how the channels of accelerometers move with the lines, and what is used."""
    if transfers.transfers:
        report.add_rows("accelerometer_lines", "Accelerometers and lines", transfers.transfers)
    report.add_rows("accelerometers", "Accelerometers", transfers.channels)
    report.data["accelerometer_shift"] = {
        name: getattr(transfers, f"shift_{name}") for name in ("frames", "error_frames")
    }
    report.notes.append(f"note: {transfers.shift_text}")


def find_places(arguments: Namespace, **gain: Path) -> dict[str, Path]:
    """Return where model and figure go, beside a gain file if there is one; refuse bad places."""
    output = Path(arguments.output)
    model = output.with_suffix(".yaml") if gain else output
    places = {**gain, "model": require_ending(model, "a model", (".yaml", ".yml"))}
    if not arguments.no_figure:
        places["figure"] = output.with_suffix(".png")
    require_writable(*places.values(), inputs=input_files(arguments))
    for path in places.values():  # of the same output, files are replaced
        if path.exists() and not output.exists():
            raise ProblemError(f"{path} would be replaced; give -o another name than {output}.")
    return places


def write_files(
    report: Report,
    places: dict[str, Path],
    arguments: Namespace,
    record: LoopRecord | SpectrumRecord,
    model: IdentifiedModel,
    *,
    designs: Mapping[str, Design] | None = None,
    accelerometers: AccelerometerTransfers | None = None,
) -> None:
    """Write gain file, model and figure, one after the other: what is ready is not lost."""
    source = ascii(Path(arguments.file).name)[1:-1]
    settings, comments = identified_config(
        model,
        **record_telescope(arguments, record),
        title=f"Identified from {source} by lbt-synth {arguments.command}.",
        accelerometers=accelerometers,
        units=shown_unit("nm")[0],
    )
    text = config_text(settings, comments).encode()
    for design in (designs or {}).values():
        kept = keep_unit(design, record.diameter_m)
        report.note_written(save_gain(places["gain"], kept))
    report.note_written(write_atomically(places["model"], text))
    report.notes += [f"note: {key} is {why}." for key, why in comments.items() if RAISED in why]
    if "figure" in places:
        figure = identification_figure(model, designs=designs)
        report.note_written(save_figure(figure, places["figure"]))


def add_record(report: Report, record: LoopRecord | SpectrumRecord) -> None:
    """Add what a record holds, and what was found wrong with it."""
    report.data["record"] = record_data(record)
    if isinstance(record, LoopRecord) and record.findings:
        caption = f"Record of {record.duration_s:.4g} s: {record.summary()}"
        report.tables.append(row_table(caption, record.findings))
    report.notes += [f"note: {note}" for note in record.notes]


def record_data(record: LoopRecord | SpectrumRecord) -> dict[str, Any]:
    """Return what JSON says of a record."""
    if isinstance(record, SpectrumRecord):
        frequencies = record.frequency_hz.size
        return {"kind": "spectrum", "frequencies": frequencies, "notes": record.notes}
    return {
        "kind": "open loop" if record.commands is None else "closed loop",
        "frames": record.frames,
        "usable": int(record.usable.sum()),
        "frame_rate_hz": record.frame_rate_hz,
        "delay_frames": record.delay_frames,
        "findings": [asdict(finding) for finding in record.findings],
        "notes": record.notes,
    }


def add_model(report: Report, model: IdentifiedModel) -> None:
    """Add the tables of an identified model, its notes, and its numbers."""
    report.tables += model_tables(model)[::-1]
    report.notes += [marked_note(note) for note in model.notes]
    report.data["axes"] = [_axis_record(axis) for axis in model.axes]
    report.data["vibrations"] = [asdict(line) for line in model.parts]
    report.data["model_notes"] = model.notes


def marked_note(note: str) -> str:
    """Mark a note as such, unless it is a warning."""
    return note if note.startswith("warning") else f"note: {note}"


def _axis_record(axis: IdentifiedAxis) -> dict[str, Any]:
    turbulence, whiteness = axis.turbulence, axis.whiteness
    tests = ("deviation", "p_value", "white")
    noise = ("noise_nm", "noise_error_nm", "noise_correlation", "noise_correlation_error")
    shown = (*noise, "sensor_gain", "sensor_gain_error", "sensor_gain_note")
    return {
        "turbulence": asdict(axis.turbulence_fit)
        | {"coefficients": turbulence.coefficients, "driving_rms_nm": turbulence.driving_rms_nm},
        "vibrations": [asdict(line) for line in axis.parts],
        **{name: getattr(axis, name) for name in (*shown, "over_fewer", "over_more")},
        "whiteness": {name: getattr(whiteness, name) for name in tests},
    }


def _with_repairs(design: Design, *records: LoopRecord) -> Design:
    """Return a design with the repairs of the commands of its records as assumptions."""
    repairs = dict.fromkeys(record.read_with for record in records if record.read_with)
    words = [f"the commands of the record were read with {options}" for options in repairs]
    return replace(design, assumptions=(*words, *design.assumptions))
