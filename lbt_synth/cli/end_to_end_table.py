"""The command end-to-end-table: Tables II and III of Agapito et al. (2008), end to end."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.display import choose_wavefront_unit
from lbt_synth.cli.end_to_end import calibrate_setup, load_setup
from lbt_synth.cli.engine import keep_finished, require_counts
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import count_progress
from lbt_synth.errors import ProblemError
from lbt_synth.interop.specula.optics import specula_version
from lbt_synth.report.figures.end_to_end import end_to_end_table_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.atomic_files import make_directory, refuse_replacing, write_atomically
from lbt_synth.storage.rows import csv_rows, json_record, json_units, row_table
from lbt_synth.studies import EndToEndEntry
from lbt_synth.studies.paper.end_to_end import (
    all_cases,
    plan_tables,
    rms_modal_difference,
    run_tables,
)

_FILES = {"II": ("table_ii.csv",), "III": ("table_iii.csv", "table_iii.png", "table_iii.pdf")}


def run(arguments: Namespace) -> Report:
    """Run Tables II and III of the paper end to end, resuming what was interrupted."""
    folder = Path(arguments.output)
    written = [folder / name for number in arguments.tables for name in _FILES[number]]
    refuse_replacing(written, [arguments.config, *arguments.gains])
    choose_wavefront_unit(arguments)
    setup = load_setup(arguments)
    designs = load_designs(arguments.gains)
    require_counts(arguments, "seeds", "row_seeds", "jobs")
    cases = {_case_name(name): design for name, design in designs.items()}
    if len(cases) < len(designs):
        raise ProblemError(
            "names of gain files must differ in letters or digits, because runs are kept under "
            f"them; got {', '.join(designs)}."
        )
    specula_version()
    rows = plan_tables(
        setup,
        cases,
        seeds=range(setup.seed, setup.seed + arguments.seeds),
        row_seeds=range(setup.seed, setup.seed + arguments.row_seeds),
        tables=arguments.tables,
    )
    total = len(all_cases(rows))
    make_directory(folder)
    case_folder = make_directory(folder / "cases")
    calibrate_setup(setup, arguments)
    with (
        count_progress(total=total, what="runs", quiet=arguments.json) as count,
        keep_finished(case_folder),
    ):
        table = run_tables(
            setup, rows, case_folder, jobs=arguments.jobs, cache=arguments.cache, progress=count
        )
    printed = {n: [entry for entry in table if entry.table == n] for n in arguments.tables}
    files = [write_atomically(folder / _FILES[n][0], csv_rows(printed[n])) for n in printed]
    differences: dict[str, float] = {}
    if "III" in printed:
        figure = end_to_end_table_figure(table)
        files += [save_figure(figure, folder / name) for name in _FILES["III"][1:]]
        methods = dict.fromkeys(entry.method for entry in printed["III"])
        differences = {method: rms_modal_difference(table, method) for method in methods}
    report = Report(
        data={
            "entries": [json_record(entry) for entry in table],
            "units": json_units(EndToEndEntry),
            "modal_distance_points": differences,
            "runs": total,
        },
        tables=[
            row_table(f"Table {n} end to end: Strehl ratio [%] at 2.2 um", entries)
            for n, entries in printed.items()
        ],
        notes=[
            f"Table III, {method}: end to end less modal {points:.1f} points rms"
            for method, points in differences.items()
        ],
    )
    report.note_files(files)
    return report


def _case_name(name: str) -> str:
    """Return a name of a design as that of files."""
    return "".join(letter if letter.isalnum() else "_" for letter in name)
