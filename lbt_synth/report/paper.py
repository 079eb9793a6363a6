"""Write the tables and figures of the paper into a directory."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from lbt_synth.design import FilterDesign
from lbt_synth.files import save_gain
from lbt_synth.methods.registry import design_label
from lbt_synth.report.figures.robustness import robustness_figure
from lbt_synth.report.figures.sigma import sigma_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.storage.display_unit import own_display_unit
from lbt_synth.storage.rows import csv_rows
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies import RobustnessRow
from lbt_synth.studies.paper.parameters import (
    TABLE_III,
    TableEntry,
    compare_with_paper,
    paper_filters,
    parameter_rows,
    table_ii,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperResult:
    """What :func:`write_paper` computed and wrote."""

    table_ii: list[TableEntry]  # Ours beside the paper's
    table_iii: list[TableEntry]
    kalman: FilterDesign  # At the true frequency
    hinf: FilterDesign
    files: list[Path]  # The files that were written


def write_paper(directory: str | os.PathLike[str], rows: list[RobustnessRow]) -> PaperResult:
    """Write tables, figures and gain files of the comparison."""
    folder = Path(directory)
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
        ("sigma", sigma_figure(filters, unit_weights=True)),
    ):
        files += [save_figure(figure, folder / f"{name}{ending}") for ending in (".png", ".pdf")]
    files += [
        save_gain(folder / "paper_kalman.fits", kalman_design),
        save_gain(folder / "paper_hinf.fits", hinf_design),
    ]
    return PaperResult(
        table_ii=second, table_iii=third, kalman=kalman_design, hinf=hinf_design, files=files
    )
