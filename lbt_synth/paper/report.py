"""Write the tables and figures of the paper into a directory."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from lbt_synth.design import FilterDesign
from lbt_synth.files import write_atomically
from lbt_synth.gainfile import save_gain
from lbt_synth.paper.compute import Comparison, compared, paper_filters, table_ii
from lbt_synth.paper.parameters import PARAMETERS, VIBRATION_HZ
from lbt_synth.paper.published import TABLE_III
from lbt_synth.plotting import robustness_figure, save_figure, sigma_figure
from lbt_synth.sweep import RobustnessRow
from lbt_synth.tables import csv_bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperResult:
    """What :func:`write_paper` computed and wrote.

    Attributes
    ----------
    table_ii, table_iii : list of Comparison
        Entries, ours beside the paper's.
    kalman, hinf : FilterDesign
        The two filters at the true frequency.
    files : list of pathlib.Path
        Files written.
    """

    table_ii: list[Comparison]
    table_iii: list[Comparison]
    kalman: FilterDesign
    hinf: FilterDesign
    files: list[Path]


def write_paper(directory: str | os.PathLike[str], rows: list[RobustnessRow]) -> PaperResult:
    """Write tables, figures and gain files of the comparison.

    Parameters
    ----------
    directory : path-like
        An existing directory.
    rows : list of RobustnessRow
        Rows of :func:`~lbt_synth.paper.compute.table_iii`.

    Returns
    -------
    PaperResult
        Comparisons and files.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    folder = Path(directory)
    second, third = table_ii(), compared(rows)
    kalman_design, hinf_design = paper_filters()
    headings = ("row", "method", "strehl_percent", "paper_strehl_percent", "difference_points")
    files = [
        write_atomically(
            folder / name,
            csv_bytes(
                headings,
                [
                    (e.label, e.method, f"{e.ours:.2f}", e.paper, f"{e.difference:.2f}")
                    for e in entries
                ],
            ),
        )
        for name, entries in (("table_ii.csv", second), ("table_iii.csv", third))
    ]
    files.append(
        write_atomically(
            folder / "parameters.csv", csv_bytes(("parameter", "value", "origin"), PARAMETERS)
        )
    )
    published = {
        method: [(row.model_hz - VIBRATION_HZ, getattr(row, method)) for row in TABLE_III]
        for method in ("kalman", "hinf")
    }
    filters = {"Kalman": kalman_design, r"H$_\infty$": hinf_design}
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
