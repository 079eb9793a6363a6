"""Run a study, or what is missing of it, and write its results; estimate what it will cost."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth
from lbt_synth.design import Design
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import load_with_digest
from lbt_synth.storage.atomic_files import (
    exclusive_lock,
    open_atomically,
    refuse_replacing,
    write_atomically,
)
from lbt_synth.storage.input_files import read_json
from lbt_synth.storage.rows import Facts, fact, facts
from lbt_synth.storage.tables import csv_bytes
from lbt_synth.studies.grid import (
    Failure,
    Parts,
    Result,
    count_workers,
    refuse,
    remove_unfinished,
    timed,
)
from lbt_synth.studies.study.sample import are_evaluated_together, evaluate_samples
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import FloatArray, integer, require_instance

MANIFEST, PARTS, RESULTS, FAILED = "study.json", "parts", "results.csv", "failed.csv"
PAGE, PRINT = "summary.html", "summary.pdf"
_SCHEMA, _SCHEMA_VERSION = "lbt_synth study", 2
_PARAMETER, _RESULT = "%.12g", "%.9g"  # formats in CSV; a replayed row has all digits
_MOST_JOBS = 64
# Rows of a part whose samples are evaluated together: some tenths of a second, of which the check
# of one sample by itself is a fifth (benchmarks/study_rates.py would be slower with fewer). Where
# each sample takes milliseconds or seconds, a killed study shall lose few of them.
_ROWS_TOGETHER, _ROWS_ONE_BY_ONE = 8192, 16
_PARTS_PER_WORKER = 4  # at least, so that none waits long for the last
_MEASURED_ROWS = 4  # of the first batch of an estimate, and the growth of the next ones
_LONG_ENOUGH_S = 1.0
_NUMBER_BYTES, _PART_BYTES = 13, 8  # of a result in the table and in a part

Evaluate = Callable[[Study, FloatArray, int], Result]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyRun:
    """What a run of a study did, and all results."""

    results: Path  # the table of results, and that of failures
    failed: Path
    columns: dict[str, FloatArray]  # row, parameters and results by name, (n,) each
    failures: tuple[Failure, ...]  # row, controller and error, in the order of the rows
    computed: int  # how many rows this run computed
    computing_s: float  # time of all parts, summed over processes [s]
    seconds: float  # time of this run [s]
    new: bool  # whether this run wrote the table of results


def run_study(
    study: Study,
    directory: str | os.PathLike[str],
    *,
    executor: Executor | None = None,
    jobs: int = 1,
    workers: int | None = None,
    evaluate: Evaluate = evaluate_samples,
    progress: Callable[[int], None] | None = None,
) -> StudyRun:
    """Run what is missing of a study, and write its results.

    Every part, a fixed number of rows, is a file in ``parts`` as soon as it is computed, written
    completely or not at all: a study that is killed at any moment, or whose worker died, resumes
    where it was. When all rows are computed, ``results.csv`` is written with one row per sample in
    order, and ``failed.csv`` with the failures.

    Parameters
    ----------
    study : Study
        The study.
    directory : path-like
        An existing directory.
    executor : concurrent.futures.Executor, optional
        Runs the parts; any executor, also a Dask ``Client.get_executor()``. It is left open.
    jobs : int, optional
        Processes, if there is no executor: at most eight per processor of the machine, or 64.
        With 1 the study runs in this process.
    workers : int, optional
        How many parts the executor runs at once, if it does not say so itself; twice as many are
        in flight.
    evaluate : callable, optional
        ``evaluate(study, values, start)`` returns columns and failures of rows of
        ``study.values``, as :func:`evaluate_samples` does. Other processes must be able to import
        it by name.
    progress : callable, optional
        Called with the number of rows that were found or finished since its last call.

    Returns
    -------
    StudyRun
        What was done, and all results. A finished study is not run again.

    Raises
    ------
    ProblemError
        If there are too many or too few jobs.
    OutputError
        If the directory belongs to another study, is in use or cannot be written, files in it
        would be replaced, or a part or a design in it was changed.
    NumericalError
        If a worker dies, or an executor breaks; what is finished is kept.

    Examples
    --------
    >>> import lbt_synth as lbt, pathlib, tempfile
    >>> text = pathlib.Path("examples/study.yaml").read_text()
    >>> with tempfile.TemporaryDirectory() as name:
    ...     folder = pathlib.Path(name)
    ...     _ = (folder / "small.yaml").write_text(text.replace("samples: 4096", "samples: 4"))
    ...     _ = (folder / "lbt.yaml").write_bytes(pathlib.Path("examples/lbt.yaml").read_bytes())
    ...     run = lbt.studies.run_study(lbt.studies.load_study(folder / "small.yaml"), folder)
    ...     again = lbt.studies.run_study(lbt.studies.load_study(folder / "small.yaml"), folder)
    >>> run.results.name, run.computed, again.computed, run.columns["kalman.strehl"].shape
    ('results.csv', 4, 0, (4,))
    """
    require_instance(study, Study)
    jobs = integer(jobs, "jobs", at_least=1)
    most = max(_MOST_JOBS, 8 * (os.cpu_count() or 1))
    if jobs > most:
        raise ProblemError(f"jobs must be at most {most} on this machine; got {jobs}.")
    at_once = integer(count_workers(executor, jobs, workers), "workers", at_least=1)
    folder = Path(directory)
    refuse_replacing(output_paths(folder, study), study.inputs)
    began = time.perf_counter()
    parts, count = study_parts(folder, study), progress or (lambda rows: None)
    with exclusive_lock(folder, "study"):
        remove_unfinished(folder, parts.folder)
        _begin(folder, study, parts)
        for path in parts.paths().values():
            parts.read(path)  # refuses what is damaged before any work
        computed = sum(stop - start for start, stop in parts.missing())
        if computed < study.samples:
            count(study.samples - computed)
        if computed:
            parts.compute_missing(
                partial(evaluate, study),
                lambda rows: (study.values(*rows), rows[0]),
                part_rows=_part_rows(study, at_once),
                executor=executor,
                jobs=at_once,
                progress=count,
            )
        contents = [parts.read(path) for path in parts.paths().values()]
        failures = sorted(failure for _, failed, _ in contents for failure in failed)
        results = np.concatenate([result for result, _, _ in contents])
        table = np.column_stack([np.arange(study.samples), study.values(), results])
        new = _write_tables(folder, study, table, failures)
    return StudyRun(
        results=folder / RESULTS,
        failed=folder / FAILED,
        columns=dict(zip(study.columns, np.ascontiguousarray(table.T), strict=True)),
        failures=tuple(failures),
        computed=computed,
        computing_s=sum(seconds for _, _, seconds in contents),
        seconds=time.perf_counter() - began,
        new=new,
    )


def study_parts(folder: Path, study: Study) -> Parts:
    """Return the parts of a study in its directory."""
    return Parts(
        folder=folder / PARTS,
        columns=study.result_columns,
        rows=study.samples,
        digest=study.digest,
    )


def output_paths(folder: Path, study: Study) -> list[Path]:
    """Return the files that a study writes into its directory, without its parts."""
    designs = [f"{name}.fits" for name in study.designed]
    return [folder / name for name in (MANIFEST, RESULTS, FAILED, PAGE, PRINT, *designs)]


def _part_rows(study: Study, workers: int) -> int:
    """Return the number of rows of a part."""
    together = all(are_evaluated_together(study, each) for each in study.controllers.values())
    share = -(-study.samples // (_PARTS_PER_WORKER * workers))
    return min(_ROWS_TOGETHER if together else _ROWS_ONE_BY_ONE, share)


def read_manifest(folder: Path, study: Study) -> dict[str, Any] | None:
    """Return the manifest of a study in its directory, None if it was not begun there."""
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        manifest = dict(read_json(path, OutputError))
        readable = (manifest["schema"], manifest["schema_version"]) == (_SCHEMA, _SCHEMA_VERSION)
        source, version, _ = manifest["source"], manifest["version"], dict(manifest["designs"])
    except (ValueError, KeyError, TypeError):
        readable = False
    if not readable:
        refuse(path, "is no manifest of a study that this version reads. Name another directory.")
    if manifest["digest"] != study.digest:
        why = (
            f"was made by lbt_synth {version}; this is {lbt_synth.__version__}"
            if version != lbt_synth.__version__
            else f"is of another study: {source} as it was, with its configuration and gain files"
        )
        refuse(folder, f"{why}. Name another directory, or delete it.")
    return manifest


def read_designs(folder: Path, study: Study) -> dict[str, Design]:
    """Return the designs that a study wrote for its controllers, none if it was not begun."""
    designs = {}
    for name, expected in ((read_manifest(folder, study) or {}).get("designs", {})).items():
        if name in study.settings.controllers:
            path = folder / f"{name}.fits"
            designs[name], digest = load_with_digest(path)
            if digest != expected:
                refuse(
                    path,
                    "is not the design that the study was begun with. Put that back, or name "
                    "another directory.",
                )
    return designs


def _begin(folder: Path, study: Study, parts: Parts) -> None:
    """Begin a study with its manifest and its designs, or check that it was begun here."""
    manifest = read_manifest(folder, study)
    if manifest is None:
        if parts.paths():
            why = f"holds parts of a study without its {MANIFEST}. Name another directory, or"
            refuse(folder, f"{why} delete {parts.folder}.")
        for path in output_paths(folder, study):
            if path.exists():
                why = "is not of a study in this directory, and would be replaced. Name another"
                refuse(path, f"{why} directory, or delete it.")
        sections = study.settings
        manifest = {
            "schema": _SCHEMA,
            "schema_version": _SCHEMA_VERSION,
            "digest": study.digest,
            "version": lbt_synth.__version__,
            "source": str(study.source),
            "samples": study.samples,
            "evaluation": sections.evaluation,
            "parameters": {name: section.text for name, section in sections.parameters.items()},
            "controllers": {name: section.text for name, section in sections.controllers.items()},
            "designs": {},
        }
        _write_manifest(folder, manifest)
    if manifest["designs"].keys() == study.designed.keys():
        read_designs(folder, study)
        return
    # begun now, or killed before they were written
    saved = {n: save_gain(folder / f"{n}.fits", design) for n, design in study.designed.items()}
    digests = {name: load_with_digest(path)[1] for name, path in saved.items()}
    _write_manifest(folder, manifest | {"designs": digests})


def _write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1).encode() + b"\n")


def _write_tables(folder: Path, study: Study, table: FloatArray, failures: list[Failure]) -> bool:
    """Write the tables of results and failures that are missing; return whether one was."""
    results, failed = folder / RESULTS, folder / FAILED
    new = not (results.exists() and failed.exists())
    if not failed.exists():
        write_atomically(failed, csv_bytes(("row", "controller", "error"), failures))
    if not results.exists():
        formats = [_PARAMETER] * len(study.parameter_names) + [_RESULT] * len(study.result_columns)
        line = ",".join(["%d", *formats]) + "\n"
        with open_atomically(results) as stream:
            stream.write((",".join(study.columns) + "\n").encode())
            for start in range(0, len(table), _ROWS_TOGETHER):
                rows = table[start : start + _ROWS_TOGETHER].tolist()
                stream.write("".join([line % tuple(row) for row in rows]).encode())
    return new


def estimate_study(
    study: Study, *, workers: int = 1, local: bool = True, evaluate: Evaluate = evaluate_samples
) -> Facts:
    """Measure a batch in this process, and estimate what the whole study will cost.

    Parameters
    ----------
    study : Study
        The study.
    workers : int, optional
        Processes that it will run on.
    local : bool, optional
        Whether they run on this machine, and so no more at once than it has processors.
    evaluate : callable, optional
        As for :func:`run_study`.

    Returns
    -------
    Facts
        ``measured_rows`` of the batch and ``measured_s``, its time in one process; ``seconds`` of
        the whole study on the requested processes; ``disk_bytes`` of its directory.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> study = lbt.studies.load_study("examples/study.yaml")
    >>> cost = lbt.studies.estimate_study(study, workers=2)
    >>> cost.seconds > 0, cost.disk_bytes
    (True, 1974272)
    """
    workers = integer(workers, "workers", at_least=1)
    start, size, rows, seconds = 0, _MEASURED_ROWS, 1, 0.0
    evaluate(study, study.values(0, 1), 0)  # warms up
    while seconds < _LONG_ENOUGH_S and start < study.samples:
        values = study.values(start, min(start + size, study.samples))
        rows, (_, seconds) = len(values), timed(evaluate, study, values, start)
        start, size = start + rows, _MEASURED_ROWS * size
    at_once = min(workers, os.cpu_count() or 1) if local else workers
    row_bytes = _NUMBER_BYTES * len(study.columns) + _PART_BYTES * len(study.result_columns)
    space = {"unit": "MB", "scale": 1e-6, "format": ".3g"}
    return facts(
        measured_rows=fact(rows, "samples measured in one process"),
        measured_s=fact(seconds, "  their time", unit="s", format=".3g"),
        seconds=fact(seconds / rows * study.samples / at_once),  # said in a note, in words
        disk_bytes=fact(study.samples * row_bytes, "space on the disk, about", **space),
    )
