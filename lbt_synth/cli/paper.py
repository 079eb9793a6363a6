"""The command paper: the tables and figures of Agapito et al. (2008), ours beside theirs."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.display import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import track_progress
from lbt_synth.methods.registry import design_title
from lbt_synth.report.paper import PaperResult, write_paper
from lbt_synth.storage.atomic_files import make_directory
from lbt_synth.storage.display_unit import own_display_unit
from lbt_synth.storage.rows import json_record
from lbt_synth.studies.paper.parameters import (
    DIAMETER_M,
    TABLE_III,
    TableEntry,
    parameter_rows,
    rms_difference,
    table_iii,
)


def run(arguments: Namespace) -> Report:
    """Compute and write the tables and figures of the paper."""
    choose_unit(arguments, DIAMETER_M)
    folder = make_directory(arguments.output)
    rows = list(
        track_progress(
            table_iii(), total=2 * len(TABLE_III), what="Table III", quiet=arguments.json
        )
    )
    result = write_paper(folder, rows)
    columns = {
        method: rms_difference([e for e in result.table_iii if e.method == method])
        for method in dict.fromkeys(entry.method for entry in result.table_iii)
    }
    with own_display_unit():  # JSON stays in nm
        parameters = parameter_rows()
    report = Report(
        data={
            "table_ii": [json_record(entry) for entry in result.table_ii],
            "table_iii": [json_record(entry) for entry in result.table_iii],
            "table_iii_rms_points": columns,
            "hinf_gamma_ratio": _gamma_ratio(result),
            "parameters": [
                dict(zip(("name", "value", "origin"), row, strict=True)) for row in parameters
            ],
        },
        notes=[
            "Table III, rms difference: "
            + ", ".join(f"{design_title(m)} {d:.2f} points" for m, d in columns.items()),
            f"H-infinity: bound at {_gamma_ratio(result):.3f} times the least at 20 Hz",
        ],
    )
    report.add_table("Parameters", ("parameter", "value", "origin"), parameter_rows())
    for number, entries in (("II", result.table_ii), ("III", result.table_iii)):
        _add_comparison(report, f"Table {number}: Strehl ratio [%] at 2.2 um", entries)
    report.note_files(result.files)
    return report


def _gamma_ratio(result: PaperResult) -> float:
    design = result.hinf
    return design.gamma_requested / design.gamma_least


def _add_comparison(report: Report, title: str, entries: list[TableEntry]) -> None:
    """Add a table with the methods side by side."""
    methods = dict.fromkeys(entry.method for entry in entries)
    headings, lines = ["row"], {entry.label: [entry.label] for entry in entries}
    for method in methods:
        headings += [f"{design_title(method)}, ours", "paper", "difference"]
    for entry in entries:  # in the order of the methods within each row
        lines[entry.label] += [
            f"{entry.ours:.1f}",
            f"{entry.paper:.1f}",
            f"{entry.difference:+.1f}",
        ]
    report.add_table(title, headings, lines.values())
