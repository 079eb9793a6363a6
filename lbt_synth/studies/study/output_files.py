"""Write and read the tables of a study: results, one row per sample in order, and failures."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lbt_synth.errors import OutputError
from lbt_synth.storage.atomic_files import open_atomically, write_atomically
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies.study.parquet import read_parquet, write_parquet
from lbt_synth.studies.study.store import FAILED, Part, read_part, refuse
from lbt_synth.studies.study.study import Failure, Study
from lbt_synth.validation import FloatArray

_PARAMETER, _RESULT = "%.12g", "%.9g"  # formats in CSV; a replayed row has all digits


def results_path(folder: Path, study: Study) -> Path:
    """Return the path of the table of results."""
    return folder / f"results.{study.settings.results}"


def write_results(folder: Path, study: Study, parts: Sequence[Part]) -> Path:
    """Write the table of results part by part, completely or not at all.

    A CSV table has 12 digits for parameters and 9 for results; a Parquet table has all digits.
    """
    path = results_path(folder, study)
    blocks = (_part_rows(study, part) for part in parts)
    with open_atomically(path) as stream:
        if study.settings.results == "parquet":
            write_parquet(stream, study.columns, blocks)
            return path
        stream.write((",".join(study.columns) + "\n").encode())
        formats = [_PARAMETER] * len(study.parameters) + [_RESULT] * len(study.result_columns)
        line = ",".join(["%d", *formats]) + "\n"
        for block in blocks:
            stream.write("".join([line % tuple(row) for row in block.tolist()]).encode())
    return path


def _part_rows(study: Study, part: Part) -> FloatArray:
    """Return numbers, parameters and results of the rows of a part side by side."""
    rows = part.start, part.stop
    return np.column_stack([np.arange(*rows), study.values(*rows), read_part(part, study)[0]])


def write_failures(folder: Path, failures: Sequence[Failure]) -> Path:
    """Write the table of failures, in the order of the rows."""
    rows = [(f.row, f.controller, f.error) for f in sorted(failures, key=lambda f: f.row)]
    return write_atomically(folder / FAILED, csv_bytes(("row", "controller", "error"), rows))


def read_failures(folder: Path) -> list[tuple[int, str, str]]:
    """Return row, controller and error of each failure, from their table."""
    with (folder / FAILED).open(encoding="utf-8", newline="") as stream:
        return [(int(row), name, error) for row, name, error in list(csv.reader(stream))[1:]]


def read_results(folder: Path, study: Study, parts: Sequence[Part] = ()) -> dict[str, FloatArray]:
    """Return all columns (n,), from the parts if there are any, else from the table of results."""
    if parts:
        stacked = np.vstack([_part_rows(study, part) for part in parts])
        return dict(zip(study.columns, stacked.T, strict=True))
    path = results_path(folder, study)
    found = (read_parquet if study.settings.results == "parquet" else _read_csv)(path)
    size = len(next(iter(found.values()), ()))
    if tuple(found) != study.columns or size != study.samples:
        refuse(
            path,
            f"is not the table of this study: it has {size} rows and {len(found)} columns, "
            f"expected are {study.samples} and {len(study.columns)}. Delete the directory, and "
            "start again.",
        )
    return found


def _read_csv(path: Path) -> dict[str, FloatArray]:
    """Return all columns of a file, (n,) each."""
    try:
        with path.open(encoding="utf-8") as stream:
            names = stream.readline().rstrip("\n").split(",")
            content = np.loadtxt(stream, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot read {path}: {error}.", path=path) from error
    return dict(zip(names, content.T, strict=False))


def read_row(folder: Path, study: Study, row: int, parts: Sequence[Part]) -> dict[str, float]:
    """Return the results of one row, none if it is not computed yet."""
    for part in parts:
        if part.start <= row < part.stop:
            found = read_part(part, study)[0][row - part.start]
            return dict(zip(study.result_columns, found.tolist(), strict=True))
    path = results_path(folder, study)
    if not path.exists():
        return {}
    if study.settings.results == "parquet":
        table = read_results(folder, study)
        return {name: float(table[name][row]) for name in study.result_columns}
    with path.open(encoding="utf-8") as stream:
        cells = next(itertools.islice(stream, row + 1, None), "").split(",")
    if len(cells) != len(study.columns) or cells[0] != str(row):
        refuse(path, f"has no row {row} of this study.")
    found = dict(zip(study.columns, map(float, cells), strict=True))
    return {name: found[name] for name in study.result_columns}
