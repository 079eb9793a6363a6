"""Outputs that a study writes: tables (.csv) and figures, as many as were asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lbt_synth.cli.output import Report
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.report.figures.style import FIGURE_ENDINGS, save_figure
from lbt_synth.storage.atomic_files import require_writable, write_atomically
from lbt_synth.storage.tables import csv_bytes


def made_directory(path: str | Path) -> Path:
    """Return a directory, made if it was not there."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the directory {folder}: {error.strerror}.", path=folder
        ) from error
    return folder


def require_outputs(outputs: Sequence[str], *, inputs: Sequence[str]) -> None:
    """Refuse names of neither a table nor a figure, inputs, and places that cannot be written."""
    for output in outputs:
        if Path(output).suffix.lower() not in (".csv", *FIGURE_ENDINGS):
            raise ProblemError(
                f"an output must end in .csv, {', '.join(FIGURE_ENDINGS)}; got {output!r}."
            )
    require_writable(*outputs, inputs=inputs)


def write_outputs(
    report: Report,
    outputs: Sequence[str],
    *,
    records: Sequence[Mapping[str, Any]],
    figure: Callable[[], Any],
) -> None:
    """Write each output, and note it in the report."""
    report.data["files"] = []
    for output in outputs:
        if Path(output).suffix.lower() == ".csv":
            path = write_atomically(output, records_csv(records))
        else:
            path = save_figure(figure(), output)
        report.data["files"].append(str(path))
        report.notes.append(f"written: {path}")


def records_csv(records: Sequence[Mapping[str, Any]]) -> bytes:
    """Return records with the same keys as a CSV table; what is not a number is left empty."""
    cells = [
        ["" if isinstance(v, float) and math.isnan(v) else v for v in record.values()]
        for record in records
    ]
    return csv_bytes(list(records[0]), cells)
