"""The command paper: the tables and figures of Agapito et al. (2008), ours beside theirs."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.loop_inputs import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import track_progress
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
from lbt_synth.studies.paper import (
    DIAMETER_M,
    TABLE_II,
    TABLE_III,
    PaperRow,
    modal_row,
    paper_filters,
    parameter_rows,
    plan_rows,
    rms_difference,
    table_entry,
)

_ROWS = 3 * len(TABLE_II) + 2 * len(TABLE_III)  # of both tables and their controllers


def run(arguments: Namespace) -> Report:
    """Compute and write the tables and figures of the paper."""
    choose_unit(arguments, DIAMETER_M)
    folder = make_directory(arguments.output)
    rows = [
        (row, modal_row(row)) for row in track_progress(plan_rows(), total=_ROWS, what="tables")
    ]
    second, third = (
        [table_entry(*pair) for pair in rows if pair[0].table == table] for table in ("II", "III")
    )
    filters = paper_filters()
    files = _write_paper(folder, rows, filters)
    ratio = filters[1].gamma_requested / filters[1].gamma_least
    by_method = [
        (number, method, [entry for entry in entries if entry.method == method])
        for number, entries in (("II", second), ("III", third))
        for method in dict.fromkeys(entry.method for entry in entries)
    ]
    columns = {method: rms_difference(entries) for n, method, entries in by_method if n == "III"}
    with own_display_unit():  # JSON stays in nm
        parameters = parameter_rows()
    report = Report(
        data={
            "table_ii": [json_record(entry) for entry in second],
            "table_iii": [json_record(entry) for entry in third],
            "table_iii_rms_points": columns,
            "hinf_gamma_ratio": ratio,
            "parameters": [
                dict(zip(("name", "value", "origin"), row, strict=True)) for row in parameters
            ],
        },
        verdict=[
            f"Table III, {design_title(method)}: {points:.2f} points rms from the paper."
            for method, points in columns.items()
        ],
        notes=[f"H-infinity: bound at {ratio:.3f} times the least at 20 Hz"],
    )
    headings = ("table", "method", "rows", "rms difference", "largest difference")
    report.add_table(
        "Strehl ratios [%] at 2.2 um, ours less the paper's",
        headings,
        [
            (
                number,
                design_title(method),
                len(entries),
                f"{rms_difference(entries):.2f}",
                f"{max((e.difference for e in entries), key=abs):+.1f}",
            )
            for number, method, entries in by_method
        ],
    )
    report.add_table("Parameters", ("parameter", "value", "origin"), parameter_rows())
    for number, entries in (("II", second), ("III", third)):
        report.add_table(
            f"Table {number}: Strehl ratio [%] at 2.2 um",
            ("row", "method", "ours", "paper", "difference"),
            [
                (
                    e.label,
                    design_title(e.method),
                    *map("{:.1f}".format, (e.ours, e.paper)),
                    f"{e.difference:+.1f}",
                )
                for e in entries
            ],
        )
    report.note_files(files)
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
