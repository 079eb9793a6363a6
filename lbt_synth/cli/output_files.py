"""Files that commands write: tables (.csv), figures, telemetry."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from lbt_synth.cli.output import Report
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, save_telemetry
from lbt_synth.files.telemetry.aot import lost_fields
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.report.draw import FIGURE_ENDINGS, require_figure_name, save_figure
from lbt_synth.storage.atomic_files import require_writable, write_atomically
from lbt_synth.storage.rows import csv_rows


def require_figure(output: str, *, inputs: Sequence[str]) -> None:
    """Refuse an output that cannot become a figure, or would replace an input."""
    require_writable(require_figure_name(output), inputs=inputs)


def require_outputs(outputs: Sequence[str], *, inputs: Sequence[str]) -> None:
    """Refuse outputs that cannot become a table or a figure, or would replace an input."""
    for output in outputs:
        if Path(output).suffix.lower() not in (".csv", *FIGURE_ENDINGS):
            raise ProblemError(
                f"an output must end in .csv, {', '.join(FIGURE_ENDINGS)}; got {output!r}."
            )
    require_writable(*outputs, inputs=inputs)


def write_outputs(
    report: Report,
    outputs: Sequence[str],
    rows: Sequence[Any],
    *,
    figure: Callable[[], Any],
    without: Collection[str] = (),
) -> None:
    """Write the rows to outputs in .csv and the figure to all others, and note them in the report.

    ``without`` names the fields of the rows that a .csv leaves out.
    """
    report.note_files(
        write_atomically(output, csv_rows(rows, without=without))
        if Path(output).suffix.lower() == ".csv"
        else save_figure(figure(), output)
        for output in outputs
    )


def write_telemetry(
    report: Report,
    output: str,
    telemetry: Telemetry,
    *,
    key: str,
    what: str = "telemetry",
    kind: str | None = None,
    precision: str = "float64",
) -> None:
    """Write telemetry, and note in the report the file and what its format leaves out."""
    kind = require_telemetry_name(output, kind)
    path = save_telemetry(output, telemetry, format=kind, precision=precision)
    lost = lost_fields(telemetry) if kind == "aot" else ()
    report.data |= {key: str(path), "lost": list(lost)}
    report.notes.append(f"written: {path} ({what})")
    if lost:
        report.notes.append(f"note: the AOT standard has no place for {', '.join(lost)}.")
