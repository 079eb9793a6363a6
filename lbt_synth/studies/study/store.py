"""The directory of a study: its manifest, its designs, its finished batches and its tables."""

from __future__ import annotations

import contextlib
import csv
import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.errors import OutputError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.storage import array_file
from lbt_synth.storage.atomic_files import (
    UNFINISHED,
    open_atomically,
    write_atomically,
)
from lbt_synth.storage.input_files import file_sha256, open_input, read_bytes, read_json
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies.study.schema import ControllerName
from lbt_synth.studies.study.study import BatchResult, Failure, Study
from lbt_synth.validation import FloatArray

MANIFEST, PARTS, RESULTS, FAILED = "study.json", "parts", "results.csv", "failed.csv"
PAGE, PRINT = "summary.html", "summary.pdf"
_PART = re.compile(r"([0-9]{10})-([0-9]{10})\.npz")
_DELETE = "Delete it, and it is computed again."
_PARAMETER, _RESULT = "%.12g", "%.9g"  # formats in CSV; a replayed row has all digits
RowRange = tuple[int, int]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
TableName = Literal["results.csv", "failed.csv"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A file with a finished batch, named by its rows: start up to stop, which is not included."""

    start: int
    stop: int
    path: Path

    def holds(self, row: int) -> bool:
        """Whether a row is in it."""
        return self.start <= row < self.stop


class Manifest(BaseModel):
    """What the manifest in the directory of a study says."""

    model_config = ConfigDict(frozen=True, strict=True, extra="allow")

    schema_: Literal["lbt_synth study"] = Field(alias="schema")
    schema_version: Literal[1]
    digest: str  # of the study
    version: str = ""  # of the package that began it
    source: str = ""
    samples: int = 0
    evaluation: str = ""
    parameters: dict[str, str] = {}  # their distributions in words
    controllers: dict[str, str] = {}  # their origins
    # digests of the gain files of the designs for the whole study, and of the finished tables
    designs: dict[ControllerName, Sha256]
    tables: dict[TableName, Sha256]
    finished: bool
    failures: int
    seconds: Seconds  # of all runs that reached their end
    computing_seconds: Seconds  # of all batches, summed over processes

    def write(self, folder: Path, **changes: Any) -> Manifest:
        """Write the manifest with some changes, and return it."""
        made = self.model_copy(update=changes)
        text = json.dumps(made.model_dump(by_alias=True), indent=1)
        write_atomically(folder / MANIFEST, text.encode() + b"\n")
        return made


def new_manifest(study: Study) -> Manifest:
    """Return the manifest of a study that begins."""
    return Manifest(
        schema="lbt_synth study",
        schema_version=1,
        digest=study.digest,
        version=lbt_synth.__version__,
        source=str(study.source),
        samples=study.samples,
        evaluation=study.settings.evaluation,
        parameters={p.name: p.distribution.text for p in study.parameters},
        controllers={c.name: c.origin for c in study.controllers},
        designs={},
        tables={},
        finished=False,
        failures=0,
        seconds=0.0,
        computing_seconds=0.0,
    )


def refuse(path: Path, why: str, cause: Exception | None = None) -> NoReturn:
    """Refuse a file or a directory."""
    raise OutputError(f"{path} {why}", path=path) from cause


def read_manifest(folder: Path, digest: str) -> Manifest | None:
    """Return the manifest of a study in its directory, None if it was not begun there."""
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        manifest = Manifest.model_validate(read_json(path, OutputError))
    except ValueError as error:  # pydantic's errors among them
        why = "is no manifest of a study that this version reads. Name another directory."
        refuse(path, why, error)
    if manifest.digest == digest:
        return manifest
    why = (
        f"was made by lbt_synth {manifest.version}; this is {lbt_synth.__version__}"
        if manifest.version != lbt_synth.__version__
        else f"is of another study: {manifest.source} as it was, with its configuration and "
        "gain files"
    )
    refuse(folder, f"{why}. Name another directory, or delete it.")


def read_designs(folder: Path, manifest: Manifest) -> dict[str, Design]:
    """Return the designs that a study wrote for its controllers."""
    designs = {}
    for name, expected in manifest.designs.items():
        path = folder / f"{name}.fits"
        designs[name], digest = load_with_digest(path)
        if digest != expected:
            refuse(
                path,
                "is not the design that the study was begun with. Put that back, or name another "
                "directory.",
            )
    return designs


def write_designs(folder: Path, study: Study) -> dict[str, str]:
    """Write the designs for the whole study, and return the digests of their files."""
    return {
        each.name: load_with_digest(save_gain(folder / f"{each.name}.fits", each.design))[1]
        for each in study.controllers
        if each.request is not None and each.design is not None
    }


def list_parts(folder: Path) -> list[Part]:
    """Return the parts in a directory, in the order of their rows."""
    parts = []
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        for path in (folder / PARTS).iterdir():
            found = _PART.fullmatch(path.name)
            if found is not None:
                parts.append(Part(start=int(found[1]), stop=int(found[2]), path=path))
    parts.sort(key=lambda part: part.start)
    for one, other in pairwise(parts):
        if other.start < one.stop:
            refuse(other.path, f"has rows that are in {one.path.name}, too. {_DELETE}")
    return parts


def missing_rows(parts: list[Part], samples: int) -> list[RowRange]:
    """Return the ranges of rows that no part has."""
    starts = [*(part.start for part in parts), samples]
    stops = [0, *(part.stop for part in parts)]
    return [(a, b) for a, b in zip(stops, starts, strict=True) if a < b]


class PartMeta(BaseModel):
    """What a part says of its results."""

    model_config = ConfigDict(frozen=True, strict=True)

    study: Sha256
    failures: list[Failure]
    seconds: Seconds
    digest: Sha256


def write_part(folder: Path, study: Study, batch: BatchResult, seconds: float) -> Part:
    """Write a finished batch."""
    results = np.column_stack([batch.columns[name] for name in study.result_columns])
    stop = batch.start + len(results)
    path = folder / PARTS / f"{batch.start:010d}-{stop:010d}.npz"
    arrays = {"RESULTS": results}
    meta: dict[str, Any] = {
        "study": study.digest,
        "failures": [asdict(failure) for failure in batch.failures],
        "seconds": seconds,
    }
    meta["digest"] = array_file.digest(arrays, meta)
    write_atomically(path, array_file.npz_bytes(arrays, json.dumps(meta)))
    return Part(start=batch.start, stop=stop, path=path)


def read_part(part: Part, study: Study) -> tuple[FloatArray, tuple[Failure, ...], float]:
    """Return the results of a part, (rows, result columns), its failures and its seconds."""
    path = part.path
    try:
        arrays, text = array_file.read_npz(read_bytes(path, OutputError))
        meta = PartMeta.model_validate_json(text)
        whole = meta.digest == array_file.digest(arrays, json.loads(text))
        results = arrays["RESULTS"]
    except (ValueError, KeyError, RecursionError) as error:
        refuse(path, f"is damaged. {_DELETE}", error)
    names = {each.name for each in study.controllers}
    if (
        not whole
        or results.shape != (part.stop - part.start, len(study.result_columns))
        or any(f.controller not in names or not part.holds(f.row) for f in meta.failures)
    ):
        refuse(path, f"is damaged. {_DELETE}")
    if meta.study != study.digest:
        refuse(path, "is of another study. Name another directory, or delete it.")
    return results, tuple(meta.failures), meta.seconds


def remove_unfinished(folder: Path) -> None:
    """Remove what a killed process left unfinished."""
    for path in [*folder.glob(UNFINISHED), *(folder / PARTS).glob(UNFINISHED)]:
        path.unlink()


def require_unchanged(folder: Path, manifest: Manifest) -> None:
    """Refuse tables of a finished study that were changed."""
    for name, digest in manifest.tables.items():
        path = folder / name
        if path.exists() and file_sha256(path, OutputError) != digest:
            refuse(path, f"is not as the study wrote it. Put that back, or {_DELETE.lower()}")


def remove_parts(folder: Path) -> None:
    """Remove the parts, and their directory if nothing else is in it."""
    for part in list_parts(folder):
        part.path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        (folder / PARTS).rmdir()


def write_results(folder: Path, study: Study, parts: Sequence[Part]) -> Path:
    """Write the table of results part by part, completely or not at all.

    Parameters have 12 digits, results 9.
    """
    path = folder / RESULTS
    with open_atomically(path) as stream:
        stream.write((",".join(study.columns) + "\n").encode())
        formats = [_PARAMETER] * len(study.parameters) + [_RESULT] * len(study.result_columns)
        line = ",".join(["%d", *formats]) + "\n"
        for part in parts:
            rows = _part_rows(study, part).tolist()
            stream.write("".join([line % tuple(row) for row in rows]).encode())
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
    path = folder / FAILED
    try:
        lines = read_bytes(path, OutputError).decode().splitlines(keepends=True)
        rows = list(csv.reader(lines, strict=True))[1:]
        return [(int(row), name, error) for row, name, error in rows]
    except (ValueError, csv.Error) as error:
        refuse(path, f"is damaged. {_DELETE}", error)


def read_results(folder: Path, study: Study, parts: Sequence[Part] = ()) -> dict[str, FloatArray]:
    """Return all columns (n,), from all parts if there are any, else from the table of results."""
    if parts:
        results = np.concatenate([read_part(part, study)[0] for part in parts])
        columns = [np.arange(float(study.samples)), *study.values().T, *results.T]
        return dict(zip(study.columns, map(np.ascontiguousarray, columns), strict=True))
    path = folder / RESULTS
    found = _read_csv(path)
    size = len(next(iter(found.values()), ()))
    if tuple(found) != study.columns or size != study.samples:
        refuse(
            path,
            f"is not the table of this study: it has {size} rows and {len(found)} columns; "
            f"expected {study.samples} and {len(study.columns)}. Delete the directory, and start "
            "again.",
        )
    return found


def _read_csv(path: Path) -> dict[str, FloatArray]:
    """Return all columns of a file, (n,) each."""
    with open_input(path, OutputError) as stream:  # a ValueError on its content, too
        names = stream.readline().decode().rstrip("\n").split(",")
        content = np.loadtxt(stream, delimiter=",", ndmin=2)
    return dict(zip(names, content.T, strict=False))


def read_row(folder: Path, study: Study, row: int, parts: Sequence[Part]) -> dict[str, float]:
    """Return the results of one row, none if it is not computed yet."""
    for part in parts:
        if part.holds(row):
            found = read_part(part, study)[0][row - part.start]
            return dict(zip(study.result_columns, found.tolist(), strict=True))
    path = folder / RESULTS
    if not path.exists():
        return {}
    with open_input(path, OutputError) as stream:
        cells = next(itertools.islice(stream, row + 1, None), b"").decode().split(",")
        if len(cells) != len(study.columns) or cells[0] != str(row):
            refuse(path, f"has no row {row} of this study.")
        found = dict(zip(study.columns, map(float, cells), strict=True))
    return {name: found[name] for name in study.result_columns}
