"""The directory of a study: its manifest, its designs, and a part for each finished batch.

A part is written completely or not at all, and named by its rows, so that the names show which
rows are missing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.errors import OutputError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.storage import array_file
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.studies.study.batch_result import BatchResult, Failure
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import FloatArray

SCHEMA, SCHEMA_VERSION = "lbt_synth study", 1
MANIFEST, PARTS, FAILED = "study.json", "parts", "failed.csv"
PAGE, PRINT = "summary.html", "summary.pdf"
_PART = re.compile(r"([0-9]{10})-([0-9]{10})\.npz")
_UNFINISHED = re.compile(r"\.(.+)\.[a-z0-9_]{8}")  # the temporary files of write_atomically
_MANIFEST_KINDS: dict[str, type | tuple[type, ...]] = {
    "digest": str,
    "designs": dict,
    "tables": dict,
    "finished": bool,
    "failures": int,
    "retry": int,
    "seconds": (int, float),
    "computing_seconds": (int, float),
}
RowRange = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A file with a finished batch: rows from start up to stop, which is not included."""

    start: int
    stop: int
    path: Path


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest of a directory, None if it has none."""
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise OutputError(
            f"cannot read {path}: {error}. Name another directory.", path=path
        ) from error
    if (
        not isinstance(content, dict)
        or content.get("schema") != SCHEMA
        or content.get("schema_version") != SCHEMA_VERSION
        or any(not isinstance(content.get(name), kind) for name, kind in _MANIFEST_KINDS.items())
    ):
        raise OutputError(
            f"{path} is no manifest of a study that this version reads. Name another directory.",
            path=path,
        )
    return content


def require_same_study(manifest: Mapping[str, Any], digest: str, folder: Path) -> None:
    """Refuse a directory whose study has another digest."""
    if manifest["digest"] == digest:
        return
    version = manifest.get("version")
    why = (
        f"was made by lbt_synth {version}; this is {lbt_synth.__version__}"
        if version != lbt_synth.__version__
        else f"is of another study: {manifest.get('source')} as it was, with its configuration and "
        "gain files"
    )
    raise OutputError(f"{folder} {why}. Name another directory, or delete it.", path=folder)


def read_design(folder: Path, name: str, manifest: Mapping[str, Any]) -> Design:
    """Return the design that a study wrote for a controller."""
    path = folder / f"{name}.fits"
    design, digest = load_with_digest(path)
    if digest != manifest["designs"][name]:
        raise OutputError(
            f"{path} is not the design that the study was begun with. Put that back, or name "
            "another directory.",
            path=path,
        )
    return design


def write_designs(folder: Path, study: Study) -> dict[str, str]:
    """Write the designs for the whole study, and return the digests of their files."""
    digests = {}
    for controller in study.controllers:
        if controller.request is not None and controller.design is not None:
            path = save_gain(folder / f"{controller.name}.fits", controller.design)
            digests[controller.name] = load_with_digest(path)[1]
    return digests


def write_manifest(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the manifest."""
    text = json.dumps({"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **content}, indent=1)
    write_atomically(folder / MANIFEST, text.encode() + b"\n")


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
            raise OutputError(
                f"{other.path} has rows that are in {one.path.name}, too. Delete it, and they are "
                "computed again.",
                path=other.path,
            )
    return parts


def missing_rows(parts: list[Part], samples: int) -> list[RowRange]:
    """Return the ranges of rows that no part has."""
    starts = [*(part.start for part in parts), samples]
    stops = [0, *(part.stop for part in parts)]
    return [(a, b) for a, b in zip(stops, starts, strict=True) if a < b]


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
        arrays, text = array_file.read_npz(path.read_bytes())
        meta = json.loads(text)
        results = arrays["RESULTS"]
        failures = tuple(Failure(**failure) for failure in meta["failures"])
        whole = meta["digest"] == array_file.digest(arrays, meta)
        seconds = float(meta["seconds"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damage_error(path) from error
    if not whole or results.shape != (part.stop - part.start, len(study.result_columns)):
        raise _damage_error(path)
    if meta["study"] != study.digest:
        raise OutputError(
            f"{path} is of another study. Name another directory, or delete it.", path=path
        )
    return results, failures, seconds


def _damage_error(path: Path) -> OutputError:
    return OutputError(f"{path} is damaged. Delete it, and its rows are computed again.", path=path)


def read_blocks(parts: list[Part], study: Study, size: int) -> Iterator[tuple[int, FloatArray]]:
    """Yield the first row and the results of blocks of so many rows, the last one shorter."""
    held: list[FloatArray] = []
    start, rows = 0, 0
    for part in parts:
        results = read_part(part, study)[0]
        while rows + len(results) >= size:
            count = size - rows
            yield start, np.concatenate([*held, results[:count]])
            held, results = [], results[count:]
            start, rows = start + size, 0
        held.append(results)
        rows += len(results)
    if rows:
        yield start, np.concatenate(held)


def remove_unfinished_files(folder: Path, names: Collection[str]) -> None:
    """Remove what a killed process left unfinished: parts, and files of the given names."""
    for place in (folder, folder / PARTS):
        with contextlib.suppress(OSError):
            for path in list(place.iterdir()):
                found = _UNFINISHED.fullmatch(path.name)
                if found is not None and (_PART.fullmatch(found[1]) or found[1] in names):
                    path.unlink()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}.", path=path) from error


def require_unchanged(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Refuse tables of a finished study that were changed."""
    for name, digest in manifest.get("tables", {}).items():
        path = folder / name
        if path.exists() and file_digest(path) != digest:
            raise OutputError(
                f"{path} is not as the study wrote it. Put that back, or delete it, and it is "
                "computed again.",
                path=path,
            )


def remove_parts(folder: Path) -> None:
    """Remove the parts, and their directory if nothing else is in it."""
    for part in list_parts(folder):
        part.path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        (folder / PARTS).rmdir()
