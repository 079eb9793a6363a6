"""The commands paper and end-to-end: Agapito et al. (2008), and loops with a pyramid."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lbt_synth.cli.arguments import given_options, input_files
from lbt_synth.cli.loop_inputs import choose_unit, keep_unit, load_designs, load_shown
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import count_progress, track_progress
from lbt_synth.cli.study import run_in_parts
from lbt_synth.cli.telemetry import write_telemetry
from lbt_synth.design import Design, FilterDesign
from lbt_synth.errors import GainFileError, ProblemError, UnstableLoopError
from lbt_synth.files import Telemetry, load_gain, save_gain
from lbt_synth.interop.specula import simulation
from lbt_synth.interop.specula.optics import Calibration, EndToEndSetup, calibrate, specula_version
from lbt_synth.interop.specula.simulation import EndToEndRun, mix_controller, unread_sensors
from lbt_synth.methods.registry import design_label, design_title
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures import loop_figure
from lbt_synth.report.figures import studies as figures
from lbt_synth.storage.atomic_files import make_directory, refuse_replacing, write_atomically
from lbt_synth.storage.display_unit import nm_text, own_display_unit
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import PERCENT, Facts, csv_rows, fact, facts, fill_row
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.storage.words import listing_text
from lbt_synth.studies import paper as published
from lbt_synth.validation import integer


def run_paper(arguments: Namespace) -> Report:
    """Compute and write the tables and figures of the paper."""
    choose_unit(arguments, published.DIAMETER_M)
    folder = make_directory(arguments.output)
    total = 3 * len(published.TABLE_II) + 2 * len(published.TABLE_III)  # with their controllers
    plan = track_progress(published.plan_rows(), total=total, what="tables")
    rows = [(row, published.modal_row(row)) for row in plan]
    tables = {
        number: [published.table_entry(*pair) for pair in rows if pair[0].line.table == number]
        for number in ("III", "II")
    }
    points = published.rms_differences(tables["III"], "ours", "paper")
    report = _report_tables(folder, tables, points, "", "the paper")
    filters, headings = published.paper_filters(), ("parameter", "value", "origin")
    with own_display_unit():  # JSON and CSV stay in nm
        parameters = published.parameter_rows()
    report.data |= {
        "hinf_gamma_ratio": filters[1].gamma_requested / filters[1].gamma_least,
        "parameters": [dict(zip(headings, row, strict=True)) for row in parameters],
    }
    report.add_table("Parameters", headings, published.parameter_rows())
    content = csv_bytes(headings, parameters)
    report.note_written(write_atomically(folder / "parameters.csv", content))
    modal = [modal for row, modal in rows if row.line.table == "III"]
    report.note_written(*_draw_paper(folder, modal, filters))
    return report


def _report_tables(
    folder: Path,
    tables: Mapping[str, Sequence[Facts]],
    points: Mapping[str, float],
    how: str,
    reference: str,
) -> Report:
    """Write tables of the paper, and say how far columns of Table III are from a reference."""
    report = Report(data={"table_iii_rms_points": points})
    report.verdict = [
        f"Table III, {design_title(method)}{how}: {rms:.2f} points rms from {reference}."
        for method, rms in points.items()
    ]
    for number, entries in tables.items():
        name = f"table_{number.lower()}"
        report.add_rows(name, f"Table {number}{how}: Strehl ratio [%] at 2.2 um", entries)
        report.note_written(write_atomically(folder / f"{name}.csv", csv_rows(entries)))
    return report


def _draw_paper(
    folder: Path, rows: list[Facts], filters: tuple[FilterDesign, FilterDesign]
) -> list[Path]:
    points = {
        design.method: [
            (entry.error_hz, getattr(entry, design.method))
            for entry in published.TABLE_III
            if entry.error_hz is not None
        ]
        for design in filters
    }
    labelled = {design_label(design.method): design for design in filters}
    drawn = {
        "robustness": figures.robustness_figure(rows, points),
        "sigma": loop_figure(labelled, "sigma", unit_weights=True),
    }
    kept = [keep_unit(design, published.DIAMETER_M) for design in filters]
    return [
        *(save_figure(drawn[n], folder / f"{n}{end}") for n in drawn for end in (".png", ".pdf")),
        *(save_gain(folder / f"paper_{design.method}.fits", design) for design in kept),
    ]


_LEAST_GAIN = 0.01  # optical gain of tip and tilt; less is what a saturated pyramid shows
_SETTINGS = ("frames", "settle_frames", "seed", "pixels")
_FILES = ("run.png", "telemetry.fits")


def run_end_to_end(arguments: Namespace) -> Report:
    """Close the loop of a gain file end to end, or run tables of the paper."""
    if arguments.tables is not None:
        return _run_tables(arguments)
    if len(arguments.gains) != 1:
        raise ProblemError(
            "an end-to-end run takes one gain file; got "
            f"{', '.join(arguments.gains) or 'none'}. --tables takes any number."
        )
    (gain,) = arguments.gains
    outputs = [Path(arguments.output) / name for name in _FILES]
    refuse_replacing(outputs, input_files(arguments))
    setup = _load_setup(arguments)
    design = load_gain(gain)
    mix_controller(setup, design)  # refuses a filter of another loop before any work
    specula_version()  # refuses where it is missing
    make_directory(arguments.output)
    figure_file, telemetry_file = outputs
    with count_progress(total=setup.modes, what="calibration") as count:
        calibration = calibrate(setup, progress=count)
    total = setup.frames + setup.settle_frames
    with count_progress(total=total, what="frames") as count:
        loop_run = simulation.run_end_to_end(setup, design, calibration=calibration, progress=count)
    _require_seen(loop_run)
    tip_nm, tilt_nm, *_ = loop_run.rms_nm
    report = Report()
    report.verdict.append(
        f"The Strehl ratio is {100 * loop_run.strehl:.1f} %, with "
        f"{nm_text(tip_nm, '.1f')} rms of tip and {nm_text(tilt_nm, '.1f')} of tilt left."
    )
    report.add_facts(
        f"End to end, Strehl ratio at {setup.imaging_wavelength_um:g} um: {setup.modes} modes, "
        f"{setup.frames} frames after {setup.settle_frames}, seed {setup.seed}",
        _run_facts(loop_run, design, calibration, gain),
    )
    if unread := unread_sensors(design):
        report.notes.append(
            "note: the pyramid is the only wavefront sensor of the simulation: the fall-back "
            f"filter of the gain file runs, without {listing_text(unread)}."
        )
    report.note_written(save_figure(figures.end_to_end_figure(loop_run), figure_file))
    write_telemetry(report, str(telemetry_file), _telemetry(loop_run, design, gain))
    return report


def _run_facts(loop_run: EndToEndRun, design: Design, calibration: Calibration, gain: str) -> Facts:
    """Return the main numbers of a run, and what it ran."""
    numbers, rms = loop_run.summary(), {"unit": "nm rms", "format": ".1f"}
    points = {**PERCENT, "unit": "points"}
    condition = float(np.linalg.cond(calibration.reconstructor))
    ratio, error = numbers["tip_tilt_gain"], numbers["tip_tilt_gain_error"]
    return facts(
        gain=fact(gain),
        method=fact(design.method),
        specula=fact(specula_version()),
        **{name: fact(getattr(loop_run.setup, name)) for name in _SETTINGS},
        strehl=fact(numbers["strehl"], "Strehl ratio", **PERCENT),
        strehl_error=fact(numbers["strehl_error"], "  standard error", **points),
        other_modes_strehl=fact(numbers["other_modes_strehl"], "  without tip and tilt", **PERCENT),
        tip_rms_nm=fact(numbers["tip_rms_nm"], "tip", **rms),
        tilt_rms_nm=fact(numbers["tilt_rms_nm"], "tilt", **rms),
        other_modes_rms_nm=fact(numbers["other_modes_rms_nm"], "other modes", **rms, fixed=True),
        tip_tilt_gain=fact(ratio, "optical gain of tip and tilt", format=".3f"),
        tip_tilt_gain_error=fact(error, "  standard error", format=".3f"),
        tip_tilt_noise_nm=fact(
            numbers["tip_tilt_noise_nm"], "what it leaves of their measurements", **rms
        ),
        condition_number=fact(condition, "condition of the reconstructor", format=".1f"),
    )


def _require_seen(loop_run: EndToEndRun) -> None:
    """Refuse a run in which the pyramid no longer sees tip and tilt."""
    if not loop_run.tip_tilt_gain > _LEAST_GAIN:
        tip, tilt, *_ = loop_run.rms_nm
        pixels = loop_run.setup.pixels
        raise UnstableLoopError(
            "the pyramid must see tip and tilt; got an optical gain of "
            f"{loop_run.tip_tilt_gain:.2g} at residuals of {nm_text(tip)} and {nm_text(tilt)} rms: "
            f"the loop ran away. Try more than {pixels} pixels (--pixels), brighter light, or "
            "lower gains."
        )


def _load_setup(arguments: Namespace) -> EndToEndSetup:
    """Load the end-to-end setup of a configuration, with the changes of the command line."""
    setup = load_shown(arguments).end_to_end
    return replace(setup, **given_options(arguments, *_SETTINGS))


def _telemetry(loop_run: EndToEndRun, design: Design, gain: str) -> Telemetry:
    setup, optical = loop_run.setup, loop_run.tip_tilt_gain
    return fill_row(
        Telemetry,
        *(loop_run, setup, setup.hardware),
        influence_matrix=None,
        sensor_gain=optical if optical > 0 else None,
        metadata={
            "name": f"end to end, {setup.modes} modes",
            "controller": f"mixed: tip and tilt by {design.method}, integrators for the rest",
            "gain_file": Path(gain).name,
            "gain_file_sha256": file_sha256(gain, GainFileError),
            "simulator": f"SPECULA {specula_version()}",
            "seed": setup.seed,
            "strehl": min(loop_run.strehl, 1.0),
            "pixels": setup.pixels,
            "settle_frames": setup.settle_frames,
            "sensor_gain_is": "optical gain of tip and tilt, measured in the loop",
        },
    )


_TABLE_FILES = {"II": ("table_ii.csv",), "III": ("table_iii.csv", "table_iii.png", "table_iii.pdf")}


def _run_tables(arguments: Namespace) -> Report:
    """Run Tables II and III of the paper end to end, resuming what was interrupted."""
    folder = Path(arguments.output)
    written = [folder / name for number in arguments.tables for name in _TABLE_FILES[number]]
    refuse_replacing(written, input_files(arguments))
    setup = _load_setup(arguments)
    designs = load_designs(arguments.gains)
    for count in ("seeds", "row_seeds"):
        integer(getattr(arguments, count), count, at_least=1)
    specula_version()
    planned = published.plan_cases(
        setup,
        designs,
        seeds=range(setup.seed, setup.seed + arguments.seeds),
        row_seeds=range(setup.seed, setup.seed + arguments.row_seeds),
        tables=arguments.tables,
    )
    total = len(published.all_cases(planned))
    case_folder = folder / "cases"
    with run_in_parts(arguments, case_folder, total=total, what="runs") as engine:
        table = published.end_to_end_tables(setup, planned, case_folder, **engine)
    tables = {n: [entry for entry in table if entry.table == n] for n in arguments.tables}
    points = published.rms_differences(tables.get("III", []), "strehl", "modal")
    report = _report_tables(folder, tables, points, " end to end", "the modal analysis")
    report.data["runs"] = total
    if "III" in tables:
        figure = figures.end_to_end_table_figure(table)
        names = _TABLE_FILES["III"][1:]
        report.note_written(*(save_figure(figure, folder / name) for name in names))
    return report
