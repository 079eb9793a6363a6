"""The commands identify, auto and diagnose: from a record to a model, a design, an autopsy."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from lbt_synth import identification
from lbt_synth.cli import loop_records
from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import choose_unit, load_designs, say_accelerometers
from lbt_synth.cli.output import BRIEF_ROWS, Report, say_checks
from lbt_synth.cli.streams import count_progress
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.identification import IdentifiedModel, LoopRecord, SpectrumRecord
from lbt_synth.identification.accelerometers.transfers import AccelerometerTransfers
from lbt_synth.identification.fit.identified_model import model_tables
from lbt_synth.loop import Imaging, loop_margins
from lbt_synth.report.page.html import require_page_names, write_page
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import json_record
from lbt_synth.storage.words import count_text

if TYPE_CHECKING:  # they load the methods of synthesis, which identify does not need
    from lbt_synth.identification import Diagnosis
    from lbt_synth.identification.auto import RecordedDesign


_STEPS = 3  # that diagnose and auto count


def run_identify(arguments: Namespace) -> Report:
    """Identify a loop from its record; write a configuration and, by default, a figure."""
    places = loop_records.find_places(arguments, arguments.output)
    record = loop_records.read_record(arguments)
    choose_unit(arguments, record.diameter_m)
    loop_records.require_comparable(arguments, record)
    options = loop_records.identification_options(arguments, record)
    doubts: tuple[str, ...] = ()
    if isinstance(record, SpectrumRecord):  # it does not hold the timing of the loop
        options |= {name: getattr(arguments, name) for name in ("frame_rate_hz", "delay_frames")}
    else:
        doubts = loop_records.judge_record(arguments, record)
    model = identification.identify(record, **options)
    report = Report(data={"source": str(arguments.file)})
    loop_records.add_record(report, record)
    loop_records.add_model(report, model)
    _say_model(report, model, record)
    transfers: AccelerometerTransfers | None = None
    if arguments.accelerometers is not None and isinstance(record, LoopRecord):
        channels, values, notes = loop_records.read_accelerations(arguments, record)
        report.notes += [f"note: {note}." for note in notes]
        try:
            transfers = identification.accelerometer_transfers(
                model, record, values, channels=channels
            )
        except LbtSynthError as error:  # the model is not lost
            report.notes.append(f"warning: the accelerometers were not compared: {error}")
        else:
            loop_records.add_accelerometers(report, transfers)
    report.notes += [loop_records.marked_note(doubt) for doubt in doubts]
    loop_records.write_files(report, places, arguments, record, model, accelerometers=transfers)
    return report


def _say_model(report: Report, model: IdentifiedModel, record: LoopRecord | SpectrumRecord) -> None:
    """Begin with the strongest vibrations, and whether the model is enough."""
    if isinstance(record, LoopRecord) and record.health.findings:
        report.notes.insert(0, f"note: {record.health.summary()}")
    white = all(axis.whiteness.white for axis in model.axes)
    leaves = "is white: the model is enough" if white else "is not white: the model lacks something"
    said = "No vibration stands out of the turbulence and the noise."
    if lines := model.parts:
        order = sorted(range(len(lines)), key=lambda place: -lines[place].rms_nm)
        strongest = lines[order[0]]
        said = (
            f"{count_text(len(lines), 'vibration')}, the strongest of "
            f"{nm_text(strongest.rms_nm, '.1f')} rms at {strongest.frequency_hz:.2f} Hz."
        )
        table = model_tables(model)[-1]
        rows = [table.rows[place] for place in order[:BRIEF_ROWS]]
        caption = f"{table.caption}, the strongest first"
        report.tables.insert(0, replace(table, caption=caption, rows=tuple(rows)))
    report.verdict += [said, f"What the model does not explain {leaves}."]


def run_auto(arguments: Namespace) -> Report:
    """Identify a loop, design its controller, test it on unseen data, write its gain file."""
    from lbt_synth.identification.auto import LEAST_SECONDS  # with it come the methods

    gain = require_gain_name(arguments.output)
    places = loop_records.find_places(arguments, arguments.model, gain=gain)
    record = loop_records.require_series(
        loop_records.read_record(arguments, LEAST_SECONDS), "auto tests its design on"
    )
    choose_unit(arguments, record.diameter_m)
    loop_records.require_comparable(arguments, record)
    channels, values, notes = None, None, tuple[str, ...]()
    if arguments.accelerometers is not None:
        channels, values, notes = loop_records.read_accelerations(arguments, record)
    imaging = loop_records.record_imaging(arguments, record)
    with count_progress(total=_STEPS, what="identifying and designing") as count:
        made = identification.design_from_record(
            record,
            method=arguments.method,
            gamma_ratio=arguments.gamma_ratio,
            imaging=imaging,
            accept_record=arguments.accept_record,
            command_scale_known=loop_records.is_scale_known(record),
            accelerations=values,
            channels=channels,
            progress=count,
            **loop_records.identification_options(arguments, record),
        )
    made = loop_records.with_repair(record, made)
    design, table = made.design, made.held_out
    report = Report(data={"source": str(arguments.file), "method": design.method})
    report.add_rows(
        "held_out",
        f"Residual on the second half of the record, by models of the first; {imaging.label}",
        list(table.entries),
    )
    report.notes += [f"note: {note}" for note in table.notes]
    _say_held_out(report, made, record, imaging)
    loop_records.add_record(report, record)
    loop_records.add_model(report, made.model)
    report.notes += [f"note: {note}." for note in notes]
    if made.channels:
        title = "Accelerometers: residual on the second half of the record"
        report.add_rows("accelerometers", title, list(made.channels))
    loop = design.close(made.model.hardware)
    report.verdict += [
        say_checks(design.certificate.checks),
        f"The loop has a modulus margin of {loop_margins(loop).modulus:.3f}.",
    ]
    report.data |= {"certificate": design.certificate.passed, "assumptions": design.assumptions}
    report.notes += [f"assumes: {assumption}." for assumption in design.assumptions]
    loop_records.write_files(report, places, arguments, record, made.model, made)
    return report


def _say_held_out(
    report: Report, made: RecordedDesign, record: LoopRecord, imaging: Imaging
) -> None:
    """Begin with what the second half of the data says of a design from the first."""
    from lbt_synth.identification.prediction.comparison import RAN

    best, name = made.held_out[made.name], made.name
    report.data |= {"gain_over_what_ran": None, "wavelength_um": imaging.wavelength_um}
    after = nm_text(best.replayed_nm, ".1f")
    said = f"The {name} leaves {after} rms on unseen data"
    if record.commands is not None:
        ran = made.held_out[RAN]
        said += f", where what ran left {nm_text(ran.replayed_nm, '.1f')}"
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
    report.notes += [loop_records.marked_note(note) for note in made.notes]


def run_diagnose(arguments: Namespace) -> Report:
    """Diagnose a record, with a design to try on it if one is given, and write the page."""
    from lbt_synth.identification.diagnosis import live_axes  # with it come the methods
    from lbt_synth.report.diagnosis import diagnosis_page, diagnosis_tables

    if arguments.output is not None:
        paths = given_options(arguments, "file", "gain", "commands", "lines_file")
        require_page_names(arguments.output, arguments.pdf, inputs=tuple(paths.values()))
    elif arguments.pdf is not None:
        raise ProblemError("--pdf is the page of -o on paper; give -o, too.")
    designs = {} if arguments.gain is None else load_designs([arguments.gain])
    both = _load_series(arguments)
    choose_unit(arguments, both.diameter_m)
    live = live_axes(both)
    record = both if len(live) in (0, both.axes) else _load_series(arguments, live)
    with count_progress(total=_STEPS, what="diagnosing") as count:
        diagnosis = identification.diagnose(
            record.bridged(),
            given=designs,
            whole=both,
            imaging=loop_records.record_imaging(arguments, record),
            progress=count,
            **loop_records.identification_options(arguments, record),
        )
    sections = diagnosis_tables(diagnosis)
    report = Report(
        data={"source": str(arguments.file), **_diagnosis_data(diagnosis)},
        verdict=list(diagnosis.verdict),
        tables=[*sections.pop("verdict")[::-1], *(t for one in sections.values() for t in one)],
        notes=[loop_records.marked_note(note) for note in diagnosis.notes],
    )
    if arguments.output is not None:
        files = (arguments.file, *([arguments.gain] if arguments.gain else []))
        page = diagnosis_page(diagnosis, files)
        report.note_files(write_page(page, arguments.output, pdf=arguments.pdf))
    return report


def _load_series(arguments: Namespace, axes: list[int] | None = None) -> LoopRecord:
    """Load the record, or some of its axes."""
    series = loop_records.load_series(arguments, axes)
    return loop_records.require_series(series, "diagnose examines")


def _diagnosis_data(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis for JSON; what could not be said is null or empty."""
    from lbt_synth.identification.diagnosis import disturbance_lines

    model, law, loop = diagnosis.model, diagnosis.law, diagnosis.loop
    commands = diagnosis.commands
    poles = {} if law is None else {"poles": [[abs(pole) for pole in row] for row in law.poles]}
    return {
        "doubt": diagnosis.doubt or None,
        "record": loop_records.record_data(diagnosis.record),
        "channels": [json_record(row) for row in diagnosis.channels],
        "commands": None if commands is None else json_record(commands.facts()),
        "control_law": None if law is None else asdict(law) | poles,
        "loop": None if loop is None else json_record(loop),
        "lines": [] if model is None else [asdict(line) for line in disturbance_lines(model)],
        "costs": [json_record(row) for row in diagnosis.costs],
        "residuals": [json_record(row) for row in diagnosis.residuals],
        "best": diagnosis.best or None,
        "notes": diagnosis.notes,
    }
