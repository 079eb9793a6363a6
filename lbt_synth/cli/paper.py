"""The command paper: the tables and figures of Agapito et al. (2008), ours beside theirs."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

from lbt_synth.cli.output import Report, TableText
from lbt_synth.cli.output_files import make_directory
from lbt_synth.cli.progress import track_progress
from lbt_synth.methods.registry import design_title
from lbt_synth.report.paper import PaperResult, write_paper
from lbt_synth.studies.paper.parameters import PARAMETERS
from lbt_synth.studies.paper.published import TABLE_III
from lbt_synth.studies.paper.tables import TableEntry, rms_difference, table_iii


def run(arguments: Namespace) -> Report:
    """Compute and write the tables and figures of the paper."""
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
    return Report(
        data={
            "table_ii": [_entry_record(e) for e in result.table_ii],
            "table_iii": [_entry_record(e) for e in result.table_iii],
            "table_iii_rms_points": columns,
            "hinf_gamma_ratio": _gamma_ratio(result),
            "parameters": [parameter._asdict() for parameter in PARAMETERS],
            "files": [str(path) for path in result.files],
        },
        tables=[
            TableText(
                title="Parameters", headings=("parameter", "value", "origin"), rows=PARAMETERS
            ),
            _comparison_table("Table II: Strehl ratio [%] at 2.2 um", result.table_ii),
            _comparison_table("Table III: Strehl ratio [%] at 2.2 um", result.table_iii),
        ],
        notes=[
            "Table III, rms difference: "
            + ", ".join(f"{design_title(m)} {d:.2f} points" for m, d in columns.items()),
            f"H-infinity: bound at {_gamma_ratio(result):.3f} times the least at 20 Hz",
            *(f"written: {path}" for path in result.files),
        ],
    )


def _gamma_ratio(result: PaperResult) -> float:
    design = result.hinf
    assert design.gamma_requested is not None
    assert design.gamma_least is not None
    return design.gamma_requested / design.gamma_least


def _entry_record(entry: TableEntry) -> dict[str, Any]:
    return {
        "row": entry.label,
        "method": entry.method,
        "strehl_percent": entry.ours,
        "paper_strehl_percent": entry.paper,
        "difference_points": entry.difference,
    }


def _comparison_table(title: str, entries: list[TableEntry]) -> TableText:
    methods = list(dict.fromkeys(e.method for e in entries))
    cells = {(e.label, e.method): e for e in entries}
    headings = ["row"]
    for method in methods:
        headings += [f"{design_title(method)}, ours", "paper", "difference"]
    rows = []
    for label in dict.fromkeys(e.label for e in entries):
        row = [label]
        for method in methods:
            entry = cells[label, method]
            row += [f"{entry.ours:.1f}", f"{entry.paper:.1f}", f"{entry.difference:+.1f}"]
        rows.append(row)
    return TableText(title=title, headings=headings, rows=rows)
