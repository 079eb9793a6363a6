"""Results of a study as files: one row a sample, in order; what failed; and back."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lbt_synth.errors import OutputError
from lbt_synth.storage.atomic_files import open_atomically, write_atomically
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies.study.batch_result import Failure
from lbt_synth.studies.study.parquet import read_parquet, write_parquet
from lbt_synth.studies.study.store import FAILED, Part, read_blocks, read_part
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import FloatArray

_BLOCK_ROWS = 65_536
_PARAMETER, _RESULT = "%.12g", "%.9g"  # a row that is replayed is computed anew, with all digits


def results_path(folder: Path, study: Study) -> Path:
    """Return the name of the table of results."""
    return folder / f"results.{study.settings.results}"


def write_results(folder: Path, study: Study, parts: Sequence[Part]) -> Path:
    """Write the table of results, part after part, whole or not at all.

    Numbers of a CSV table have 12 digits for parameters and 9 for results; a Parquet table has
    them all.
    """
    path = results_path(folder, study)
    with open_atomically(path) as stream:
        if study.settings.results == "parquet":
            write_parquet(stream, study.columns, _table_blocks(study, parts))
            return path
        stream.write((",".join(study.columns) + "\n").encode())
        line = ",".join(
            [
                "%d",
                *[_PARAMETER] * len(study.parameters),
                *[_RESULT] * len(study.result_columns),
            ]
        )
        for start, values in _table_blocks(study, parts):
            rows = enumerate(values.tolist(), start)
            stream.write("".join([f"{line % (row, *cells)}\n" for row, cells in rows]).encode())
    return path


def _table_blocks(study: Study, parts: Sequence[Part]) -> Iterator[tuple[int, FloatArray]]:
    """Yield parameters and results together."""
    for start, results in read_blocks(list(parts), study, _BLOCK_ROWS):
        yield start, np.hstack([study.values(start, start + len(results)), results])


def write_failures(folder: Path, failures: Sequence[Failure]) -> Path:
    """Write the table of what failed, in the order of the rows."""
    rows = [
        (failure.row, failure.controller, failure.error)
        for failure in sorted(failures, key=lambda failure: failure.row)
    ]
    return write_atomically(folder / FAILED, csv_bytes(("row", "controller", "error"), rows))


def read_failures(folder: Path) -> list[tuple[int, str, str]]:
    """Return row, controller and error of what failed, from the table of failures."""
    with (folder / FAILED).open(encoding="utf-8", newline="") as stream:
        return [(int(row), name, error) for row, name, error in list(csv.reader(stream))[1:]]


def read_results(folder: Path, study: Study, parts: Sequence[Part] = ()) -> dict[str, FloatArray]:
    """Return all columns: of the parts if there are some, else of the table of results.

    Shapes: returns (n,).
    """
    if parts:
        rows = np.concatenate([np.arange(part.start, part.stop) for part in parts])
        values = np.vstack([study.values(part.start, part.stop) for part in parts])
        results = np.vstack([read_part(part, study)[0] for part in parts])
        stacked = [rows.astype(np.float64), *values.T, *results.T]
        return dict(zip(study.columns, stacked, strict=True))
    path = results_path(folder, study)
    if study.settings.results == "parquet":
        found = read_parquet(path)
        names: Sequence[str] = list(found)
        size = len(next(iter(found.values()), np.zeros(0)))
    else:
        try:
            with path.open(encoding="utf-8") as stream:
                names = stream.readline().rstrip("\n").split(",")
                content = np.loadtxt(stream, delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise OutputError(f"cannot read {path}: {error}.", path=path) from error
        found = dict(zip(names, content.T, strict=False))
        size = len(content)
    if tuple(names) != study.columns or size != study.samples:
        raise OutputError(
            f"{path} is not the table of this study: it has {size} rows and {len(names)} columns, "
            f"expected are {study.samples} and {len(study.columns)}. Delete the directory, and "
            "start again.",
            path=path,
        )
    return found


def read_row(folder: Path, study: Study, row: int, parts: Sequence[Part]) -> dict[str, float]:
    """Return the results of one row, as far as they are there."""
    for part in parts:
        if part.start <= row < part.stop:
            found = read_part(part, study)[0][row - part.start]
            return dict(zip(study.result_columns, found.tolist(), strict=True))
    if not results_path(folder, study).exists():
        return {}
    if study.settings.results == "parquet":
        table = read_results(folder, study)
        return {name: float(table[name][row]) for name in study.result_columns}
    cells: list[str] = []
    with contextlib.suppress(OSError), results_path(folder, study).open(encoding="utf-8") as stream:
        for number, line in enumerate(stream):
            if number == row + 1:
                cells = line.split(",")
                break
    if len(cells) != len(study.columns) or cells[0] != str(row):
        raise OutputError(
            f"{results_path(folder, study)} has no row {row} of this study.",
            path=results_path(folder, study),
        )
    first = 1 + len(study.parameters)
    return dict(zip(study.result_columns, map(float, cells[first:]), strict=True))
