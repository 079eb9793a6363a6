"""The command paper: the tables and figures of Agapito et al. (2008), ours beside theirs."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

from lbt_synth.cli.display import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import track_progress
from lbt_synth.design import FilterDesign
from lbt_synth.files import save_gain
from lbt_synth.methods.registry import design_label, design_title
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures import loop_figure, robustness_figure
from lbt_synth.storage.atomic_files import make_directory, write_atomically
from lbt_synth.storage.display_unit import own_display_unit
from lbt_synth.storage.rows import csv_rows, json_record
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies import RobustnessRow
from lbt_synth.studies.paper.parameters import (
    DIAMETER_M,
    TABLE_III,
    TableEntry,
    compare_with_paper,
    paper_filters,
    parameter_rows,
    rms_difference,
    table_ii,
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperResult:
    """What the command computed and wrote."""

    table_ii: list[TableEntry]  # Ours beside the paper's
    table_iii: list[TableEntry]
    kalman: FilterDesign  # At the true frequency
    hinf: FilterDesign
    files: list[Path]  # The files that were written


def write_paper(folder: Path, rows: list[RobustnessRow]) -> PaperResult:
    """Write tables, figures and gain files of the comparison."""
    second, third = table_ii(), compare_with_paper(rows)
    kalman_design, hinf_design = paper_filters()
    files = [
        write_atomically(folder / name, csv_rows(entries))
        for name, entries in (("table_ii.csv", second), ("table_iii.csv", third))
    ]
    with own_display_unit():  # CSV stays in nm
        parameters = csv_bytes(("parameter", "value", "origin"), parameter_rows())
    files.append(write_atomically(folder / "parameters.csv", parameters))
    published = {
        name: [(e.error_hz, getattr(e, name)) for e in TABLE_III if e.error_hz is not None]
        for name in (kalman_design.method, hinf_design.method)
    }
    filters = {design_label(design.method): design for design in (kalman_design, hinf_design)}
    for name, figure in (
        ("robustness", robustness_figure(rows, published)),
        ("sigma", loop_figure(filters, "sigma", unit_weights=True)),
    ):
        files += [save_figure(figure, folder / f"{name}{ending}") for ending in (".png", ".pdf")]
    files += [
        save_gain(folder / "paper_kalman.fits", kalman_design),
        save_gain(folder / "paper_hinf.fits", hinf_design),
    ]
    return PaperResult(
        table_ii=second, table_iii=third, kalman=kalman_design, hinf=hinf_design, files=files
    )
