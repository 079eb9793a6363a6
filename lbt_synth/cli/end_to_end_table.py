"""The command end-to-end-table: Tables II and III of Agapito et al. (2008), end to end."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lbt_synth.cli.end_to_end_setup import calibrate_setup, load_setup
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report, TableText, format_fixed, tabulate
from lbt_synth.cli.output_files import make_directory, records_csv
from lbt_synth.cli.progress import count_progress
from lbt_synth.errors import ProblemError
from lbt_synth.interop.specula.optics import specula_version
from lbt_synth.report.figures.end_to_end_table import end_to_end_table_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.atomic_files import refuse_replacing, write_atomically
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
    setup = load_setup(arguments)
    designs = load_designs(arguments.gains)
    if min(arguments.seeds, arguments.row_seeds, arguments.jobs) < 1:
        raise ProblemError("--seeds, --row-seeds and --jobs must be at least 1.")
    specula_version()
    rows = plan_tables(
        setup,
        {_case_name(name): design for name, design in designs.items()},
        seeds=range(setup.seed, setup.seed + arguments.seeds),
        row_seeds=range(setup.seed, setup.seed + arguments.row_seeds),
        tables=arguments.tables,
    )
    total = len(all_cases(rows))
    make_directory(folder)
    case_folder = make_directory(folder / "cases")
    calibrate_setup(setup, arguments)
    with count_progress(total=total, what="runs", quiet=arguments.json) as count:
        table = run_tables(
            setup, rows, case_folder, jobs=arguments.jobs, cache=arguments.cache, progress=count
        )
    files = [
        write_atomically(
            folder / _FILES[number][0],
            records_csv([_record(entry) for entry in table if entry.table == number]),
        )
        for number in arguments.tables
    ]
    differences: dict[str, float] = {}
    if "III" in arguments.tables:
        figure = end_to_end_table_figure(table)
        files += [save_figure(figure, folder / name) for name in _FILES["III"][1:]]
        methods = dict.fromkeys(e.method for e in table if e.table == "III")
        differences = {method: rms_modal_difference(table, method) for method in methods}
    return Report(
        data={
            "entries": [_record(entry) for entry in table],
            "modal_distance_points": differences,
            "runs": total,
            "files": [str(path) for path in files],
        },
        tables=[_printed_table(table, number) for number in arguments.tables],
        notes=[
            *(
                f"Table III, {method}: end to end less modal {points:.1f} points rms"
                for method, points in differences.items()
            ),
            *(f"written: {path}" for path in files),
        ],
    )


def _case_name(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in Path(name).stem)


def _record(entry: EndToEndEntry) -> dict[str, Any]:
    return {
        "table": entry.table,
        "row": entry.label,
        "method": entry.method,
        "error_hz": entry.error_hz,
        "strehl_percent": entry.strehl,
        "scatter_points": entry.scatter,
        "seeds": len(entry.strehls),
        "paper_strehl_percent": entry.paper,
        "modal_strehl_percent": entry.modal,
        "optical_gain": entry.optical_gain,
        "tip_rms_nm": entry.tip_rms_nm,
        "tilt_rms_nm": entry.tilt_rms_nm,
        "other_modes_strehl_percent": entry.other_modes,
    }


def _printed_table(table: Sequence[EndToEndEntry], number: str) -> TableText:
    return tabulate(
        f"Table {number} end to end: Strehl ratio [%] at 2.2 um",
        [entry for entry in table if entry.table == number],
        ("row", lambda entry: entry.label),
        ("method", lambda entry: entry.method),
        ("end to end", lambda entry: f"{entry.strehl:.1f}"),
        ("scatter", lambda entry: format_fixed(entry.scatter, 1)),
        ("seeds", lambda entry: len(entry.strehls)),
        ("paper", lambda entry: format_fixed(entry.paper, 1)),
        ("modal", lambda entry: f"{entry.modal:.1f}"),
        ("optical gain", lambda entry: f"{entry.optical_gain:.3f}"),
        ("tip [nm]", lambda entry: f"{entry.tip_rms_nm:.0f}"),
        ("tilt [nm]", lambda entry: f"{entry.tilt_rms_nm:.0f}"),
        ("other modes [%]", lambda entry: f"{entry.other_modes:.1f}"),
    )
