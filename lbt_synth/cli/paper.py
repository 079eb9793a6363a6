"""The commands paper and end-to-end: Agapito et al. (2008), and loops with a pyramid."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import given_options, option_name
from lbt_synth.cli.loop_inputs import choose_unit, load_designs, load_shown
from lbt_synth.cli.output import PERCENT, Report
from lbt_synth.cli.streams import count_progress, track_progress
from lbt_synth.cli.study import run_in_parts
from lbt_synth.design import Design, FilterDesign
from lbt_synth.errors import GainFileError, ProblemError, UnstableLoopError
from lbt_synth.files import Telemetry, load_gain, save_gain, save_telemetry
from lbt_synth.interop.specula import simulation
from lbt_synth.interop.specula.optics import Calibration, EndToEndSetup, calibrate, specula_version
from lbt_synth.interop.specula.simulation import EndToEndRun, mix_controller, unread_sensors
from lbt_synth.methods.registry import design_label, design_title
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures import loop_figure
from lbt_synth.report.figures.studies import (
    end_to_end_figure,
    end_to_end_table_figure,
    robustness_figure,
)
from lbt_synth.storage.atomic_files import make_directory, refuse_replacing, write_atomically
from lbt_synth.storage.display_unit import nm_text, own_display_unit
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import (
    Facts,
    csv_rows,
    fact,
    facts,
    fill_row,
    json_record,
    json_units,
    row_table,
)
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.storage.words import listing_text
from lbt_synth.studies.paper import (
    DIAMETER_M,
    TABLE_II,
    TABLE_III,
    PaperRow,
    all_cases,
    end_to_end_tables,
    modal_row,
    paper_filters,
    parameter_rows,
    plan_cases,
    plan_rows,
    rms_difference,
    rms_modal_difference,
    table_entry,
)
from lbt_synth.studies.robustness import RobustnessRow
from lbt_synth.validation import integer

_ROWS = 3 * len(TABLE_II) + 2 * len(TABLE_III)  # of both tables and their controllers


def run_paper(arguments: Namespace) -> Report:
    """Compute and write the tables and figures of the paper."""
    choose_unit(arguments, DIAMETER_M)
    folder = make_directory(arguments.output)
    rows = [
        (row, modal_row(row)) for row in track_progress(plan_rows(), total=_ROWS, what="tables")
    ]
    tables = {
        number: [table_entry(*pair) for pair in rows if pair[0].table == number]
        for number in ("II", "III")
    }
    methods = dict.fromkeys(entry.method for entry in tables["III"])
    columns = {m: rms_difference([e for e in tables["III"] if e.method == m]) for m in methods}
    filters = paper_filters()
    with own_display_unit():  # JSON stays in nm
        parameters = parameter_rows()
    names = ("name", "value", "origin")
    report = Report(
        data={
            **{f"table_{n.lower()}": [json_record(e) for e in tables[n]] for n in tables},
            "table_iii_rms_points": columns,
            "hinf_gamma_ratio": filters[1].gamma_requested / filters[1].gamma_least,
            "parameters": [dict(zip(names, row, strict=True)) for row in parameters],
        },
        verdict=[
            f"Table III, {design_title(method)}: {points:.2f} points rms from the paper."
            for method, points in columns.items()
        ],
    )
    for number, entries in reversed(tables.items()):
        caption = f"Table {number}: Strehl ratio [%] at 2.2 um"
        report.tables.append(row_table(caption, entries))
    report.add_table("Parameters", ("parameter", "value", "origin"), parameter_rows())
    report.note_files(_write_paper(folder, rows, filters))
    return report


def _write_paper(
    folder: Path,
    rows: list[tuple[PaperRow, RobustnessRow]],
    filters: tuple[FilterDesign, FilterDesign],
) -> list[Path]:
    """Write tables, figures and gain files of the comparison."""
    files = []
    for table, name in (("II", "table_ii.csv"), ("III", "table_iii.csv")):
        content = csv_rows([table_entry(*pair) for pair in rows if pair[0].table == table])
        files.append(write_atomically(folder / name, content))
    with own_display_unit():  # CSV stays in nm
        parameters = csv_bytes(("parameter", "value", "origin"), parameter_rows())
    files.append(write_atomically(folder / "parameters.csv", parameters))
    published = {
        name: [(e.error_hz, getattr(e, name)) for e in TABLE_III if e.error_hz is not None]
        for name in (design.method for design in filters)
    }
    labelled = {design_label(design.method): design for design in filters}
    for name, figure in (
        ("robustness", robustness_figure([m for row, m in rows if row.table == "III"], published)),
        ("sigma", loop_figure(labelled, "sigma", unit_weights=True)),
    ):
        files += [save_figure(figure, folder / f"{name}{ending}") for ending in (".png", ".pdf")]
    names = ("paper_kalman.fits", "paper_hinf.fits")
    return files + [save_gain(folder / n, one) for n, one in zip(names, filters, strict=True)]


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
    refuse_replacing(outputs, [arguments.config, gain])
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
    recorded = _telemetry(loop_run, design, gain)
    report.note_files(
        [
            save_figure(end_to_end_figure(loop_run), figure_file),
            save_telemetry(telemetry_file, recorded),
        ]
    )
    return report


def _run_facts(loop_run: EndToEndRun, design: Design, calibration: Calibration, gain: str) -> Facts:
    """Return the main numbers of a run, and what it ran."""
    numbers, rms = loop_run.summary(), {"unit": "nm rms", "format": ".1f"}
    headings: dict[str, tuple[str, Mapping[str, Any]]] = {
        "strehl": ("Strehl ratio", PERCENT),
        "strehl_error": ("  standard error", {**PERCENT, "unit": "points"}),
        "other_modes_strehl": ("  without tip and tilt", PERCENT),
        "tip_rms_nm": ("tip", rms),
        "tilt_rms_nm": ("tilt", rms),
        "other_modes_rms_nm": ("all other modes", rms),
        "tip_tilt_gain": ("optical gain of tip and tilt", {"format": ".3f"}),
        "tip_tilt_gain_error": ("  standard error", {"format": ".3f"}),
        "tip_tilt_noise_nm": ("what it leaves of their measurements", rms),
    }
    condition = float(np.linalg.cond(calibration.reconstructor))
    return facts(
        gain=fact(gain),
        method=fact(design.method),
        specula=fact(specula_version()),
        **{name: fact(getattr(loop_run.setup, name)) for name in _SETTINGS},
        **{name: fact(numbers[name], text, **how) for name, (text, how) in headings.items()},
        condition_number=fact(condition, "condition of the reconstructor", format=".1f"),
    )


def _require_seen(loop_run: EndToEndRun) -> None:
    """Refuse a run in which the pyramid no longer sees tip and tilt."""
    if not loop_run.tip_tilt_gain > _LEAST_GAIN:
        tip, tilt, *_ = loop_run.rms_nm
        pixels = loop_run.setup.pixels
        raise UnstableLoopError(
            "the pyramid must see tip and tilt; got an optical gain of "
            f"{loop_run.tip_tilt_gain:.2g} at residuals of {tip:.3g} and {tilt:.3g} nm rms: the "
            f"loop ran away. Try more than {pixels} pixels (--pixels), brighter light, or lower "
            "gains."
        )


def _load_setup(arguments: Namespace) -> EndToEndSetup:
    """Load the end-to-end setup of a configuration, with the changes of the command line."""
    setup = load_shown(arguments, all_modes=True).end_to_end
    return replace(setup, **given_options(arguments, "pixels", "frames", "settle_frames", "seed"))


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
    refuse_replacing(written, [arguments.config, *arguments.gains])
    setup = _load_setup(arguments)
    designs = load_designs(arguments.gains)
    for count in ("seeds", "row_seeds", "jobs"):
        integer(getattr(arguments, count), option_name(count), at_least=1)
    specula_version()
    plan: dict[str, Any] = {
        "seeds": range(setup.seed, setup.seed + arguments.seeds),
        "row_seeds": range(setup.seed, setup.seed + arguments.row_seeds),
        "tables": arguments.tables,
    }
    total = len(all_cases(plan_cases(setup, designs, **plan)))
    make_directory(folder)
    case_folder = folder / "cases"
    with run_in_parts(arguments, case_folder, total=total, what="runs") as engine:
        table = end_to_end_tables(setup, case_folder, designs, **plan, **engine)
    printed = {n: [entry for entry in table if entry.table == n] for n in arguments.tables}
    files = [write_atomically(folder / _TABLE_FILES[n][0], csv_rows(printed[n])) for n in printed]
    if "III" in printed:
        figure = end_to_end_table_figure(table)
        files += [save_figure(figure, folder / name) for name in _TABLE_FILES["III"][1:]]
    methods = dict.fromkeys(entry.method for entry in printed.get("III", ()))
    differences = {method: rms_modal_difference(table, method) for method in methods}
    report = Report(
        data={
            "entries": [json_record(entry) for entry in table],
            "units": json_units(table[0]),
            "modal_distance_points": differences,
            "runs": total,
        },
        tables=[
            row_table(f"Table {n} end to end: Strehl ratio [%] at 2.2 um", entries)
            for n, entries in printed.items()
        ],
        verdict=[
            f"Table III, {method}: end to end less modal {points:.1f} points rms."
            for method, points in differences.items()
        ],
    )
    report.note_files(files)
    return report
