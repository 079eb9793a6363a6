"""Run a study, or what is missing of it, and write its results."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lbt_synth
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.storage.atomic_files import refuse_replacing
from lbt_synth.storage.worker_processes import exclusive_lock
from lbt_synth.studies.study.batch_evaluation import evaluate_samples
from lbt_synth.studies.study.engine import Evaluate, run_batches
from lbt_synth.studies.study.output_files import (
    read_results,
    results_path,
    write_failures,
    write_results,
)
from lbt_synth.studies.study.parquet import require_parquet
from lbt_synth.studies.study.store import (
    FAILED,
    MANIFEST,
    PAGE,
    PARTS,
    PRINT,
    Part,
    file_digest,
    list_parts,
    missing_rows,
    read_design,
    read_manifest,
    read_part,
    remove_parts,
    remove_unfinished_files,
    require_same_study,
    require_unchanged,
    write_designs,
    write_manifest,
    write_part,
)
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import FloatArray, integer, require_instance

_MOST_JOBS = 64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishedStudy:
    """All results of a study."""

    columns: dict[str, FloatArray]  # (n,): all columns by their names
    computing_s: float  # Time of all batches, of all processes together [s]
    new: bool  # Whether some were computed now; else they are those of the table


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyRun:
    """What a run of a study did.

    Attributes
    ----------
    directory, results, failed : pathlib.Path
        Directory, table of results and table of failures.
    samples : int
        Rows of the results.
    computed : int
        How many of them this run computed.
    failures : int
        Controllers of samples that have no result.
    retry : int
        How many of these are tried again when the study is started again.
    computing_s, seconds : float
        Time of this run until the last row was there, and as a whole [s].
    """

    directory: Path
    results: Path
    failed: Path
    samples: int
    computed: int
    failures: int
    retry: int
    computing_s: float
    seconds: float


def run_study(
    study: Study,
    directory: str | os.PathLike[str],
    *,
    executor: Executor | None = None,
    jobs: int = 1,
    workers: int | None = None,
    evaluate: Evaluate = evaluate_samples,
    progress: Callable[[int], None] | None = None,
    whole: Callable[[FinishedStudy], None] | None = None,
) -> StudyRun:
    """Run what is missing of a study, and write its results.

    Every finished batch is a file in ``parts``, whole or not at all: killed at any moment, a
    study goes on where it was. When all rows are there, ``results.csv`` or ``results.parquet``
    is written with one row a sample in order, ``failed.csv`` with what failed, and the parts are
    removed.

    Parameters
    ----------
    study : Study
        The study.
    directory : path-like
        An existing directory.
    executor : concurrent.futures.Executor, optional
        Runs the batches: any, a Dask ``Client.get_executor()`` too. It is left open.
    jobs : int, optional
        Processes, if there is no executor, at most eight times those that the machine has at once
        (or 64); 1 runs in this one.
    workers : int, optional
        How many batches the executor runs at once, as far as it does not tell; twice as many are
        in flight.
    evaluate : callable, optional
        ``evaluate(study, values, start)`` returns the :class:`BatchResult` of rows of
        ``study.values``; importable by name where other processes run it.
    progress : callable, optional
        Called with the number of rows that were found or finished since its last call.
    whole : callable, optional
        Called with all results when all rows are there: before the manifest says so, so that
        what it does is done again if it fails. A study that was finished before calls it, too.

    Returns
    -------
    StudyRun
        What was done. A study that is finished is not run again.

    Raises
    ------
    ProblemError
        If there are too many or too few jobs.
    OutputError
        If the directory is of another study, is in use or cannot be written, files in it would be
        replaced, or its results were changed.
    NumericalError
        If processes die without end, or an executor breaks; what is finished is kept.
    MissingExtraError
        If the results shall be Parquet and pyarrow is not installed.

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
    >>> run.results.name, run.computed, again.computed
    ('results.csv', 4, 0)
    """
    require_instance(study, Study)
    jobs = integer(jobs, "jobs", at_least=1)
    most = max(_MOST_JOBS, 8 * (os.cpu_count() or 1))
    if jobs > most:
        raise ProblemError(f"jobs must be at most {most} on this machine; got {jobs}.")
    if executor is not None:
        known = workers or getattr(executor, "_max_workers", None) or os.cpu_count() or 1
        workers = integer(known, "workers", at_least=1)
    folder = Path(directory)
    if study.settings.results == "parquet":
        require_parquet()
    refuse_replacing(output_paths(folder, study), study.inputs)
    began = time.perf_counter()
    with exclusive_lock(folder, "study"):
        remove_unfinished_files(folder, [path.name for path in output_paths(folder, study)])
        manifest = _begin(folder, study)
        tables = (results_path(folder, study), folder / FAILED)
        finished = bool(manifest["finished"]) and all(path.exists() for path in tables)
        if finished:
            require_unchanged(folder, manifest)
        parts = _usable_parts(folder, study)
        if finished and not manifest["retry"]:
            remove_parts(folder)  # killed while it removed them
            parts = []
        computed, computing_s = 0, 0.0
        if not finished or manifest["retry"]:
            if manifest["finished"]:  # until its tables are those of all parts again
                manifest = manifest | {"finished": False, "tables": {}}
                write_manifest(folder, manifest)
            computed = _compute_missing(
                study,
                folder,
                parts,
                executor=executor,
                jobs=jobs,
                workers=workers,
                evaluate=evaluate,
                progress=progress,
            )
            computing_s = time.perf_counter() - began
            manifest = _write_tables(folder, study, manifest, computed, began, whole)
        else:
            if progress is not None:
                progress(study.samples)
            if whole is not None:
                columns = read_results(folder, study)
                spent = manifest["computing_seconds"]
                whole(FinishedStudy(columns=columns, computing_s=spent, new=False))
    return StudyRun(
        directory=folder,
        results=results_path(folder, study),
        failed=folder / FAILED,
        samples=study.samples,
        computed=computed,
        failures=manifest["failures"],
        retry=manifest["retry"],
        computing_s=computing_s,
        seconds=time.perf_counter() - began,
    )


def output_paths(folder: Path, study: Study) -> list[Path]:
    """Return the files that a study writes into its directory, but for its parts."""
    made = [c.name for c in study.controllers if c.request is not None and c.design is not None]
    tables = [results_path(folder, study).name, FAILED, PAGE, PRINT]
    names = [MANIFEST, *tables, *(f"{name}.fits" for name in made)]
    return [folder / name for name in names]


def _begin(folder: Path, study: Study) -> dict[str, Any]:
    """Return the manifest of a directory, of a new study if there is none."""
    manifest = read_manifest(folder)
    if manifest is not None:
        require_same_study(manifest, study.digest, folder)
        for name in manifest["designs"]:
            read_design(folder, name, manifest)
    elif list_parts(folder):
        raise OutputError(
            f"{folder} holds parts of a study without its {MANIFEST}. Name another directory, or "
            f"delete {folder / PARTS}.",
            path=folder,
        )
    else:
        for path in output_paths(folder, study):
            if path.exists():
                raise OutputError(
                    f"{path} is of no study that was begun there, and would be replaced. Name "
                    "another directory, or delete it.",
                    path=path,
                )
        manifest = {
            "digest": study.digest,
            "version": lbt_synth.__version__,
            "source": str(study.source),
            "samples": study.samples,
            "evaluation": study.settings.evaluation,
            "parameters": {p.name: p.distribution.text for p in study.parameters},
            "controllers": {c.name: c.origin for c in study.controllers},
            "designs": {},
            "tables": {},
            "settings": study.settings.model_dump(by_alias=True, exclude_none=True),
            "finished": False,
            "failures": 0,
            "retry": 0,
            "seconds": 0.0,
            "computing_seconds": 0.0,
        }
        write_manifest(folder, manifest)
    wanted = {c.name for c in study.controllers if c.request is not None and not c.for_sample}
    if set(manifest["designs"]) != wanted:  # begun now, or killed before they were written
        manifest = manifest | {"designs": write_designs(folder, study)}
        write_manifest(folder, manifest)
    return manifest


def _usable_parts(folder: Path, study: Study) -> list[Part]:
    """Return the parts that need not be computed again; those that are to be are removed."""
    usable = []
    for part in list_parts(folder):
        failures = read_part(part, study)[1]
        if any(failure.retry for failure in failures):  # a single row, see the engine
            part.path.unlink()
        else:
            usable.append(part)
    return usable


def _compute_missing(
    study: Study,
    folder: Path,
    parts: Sequence[Part],
    *,
    progress: Callable[[int], None] | None,
    **how: Any,
) -> int:
    """Compute the rows that are missing, and return how many they were."""
    missing = missing_rows(list(parts), study.samples)
    wanted = sum(stop - start for start, stop in missing)
    try:
        (folder / PARTS).mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the directory {folder / PARTS}: {error.strerror}.", path=folder
        ) from error
    if progress is not None and wanted < study.samples:
        progress(study.samples - wanted)
    with contextlib.closing(run_batches(study, missing, **how)) as coming:
        for batch, seconds in coming:
            part = write_part(folder, study, batch, seconds)
            if progress is not None:
                progress(part.stop - part.start)
    return wanted


def _write_tables(
    folder: Path,
    study: Study,
    manifest: dict[str, Any],
    computed: int,
    began: float,
    whole: Callable[[FinishedStudy], None] | None,
) -> dict[str, Any]:
    """Write the results of all parts, then the manifest, then remove the parts."""
    parts = list_parts(folder)
    recorded = [read_part(part, study)[1:] for part in parts]
    failures = [failure for failed, _ in recorded for failure in failed]
    spent = sum(seconds for _, seconds in recorded)
    tables = (write_results(folder, study, parts), write_failures(folder, failures))
    if whole is not None:
        whole(
            FinishedStudy(columns=read_results(folder, study, parts), computing_s=spent, new=True)
        )
    retry = sum(failure.retry for failure in failures)
    manifest = manifest | {
        "finished": True,
        "tables": {path.name: file_digest(path) for path in tables},
        "settings": study.settings.model_dump(by_alias=True, exclude_none=True),
        "failures": len(failures),
        "retry": retry,
        "computed_last": computed,
        "seconds": manifest["seconds"] + time.perf_counter() - began,
        "computing_seconds": spent,
    }
    write_manifest(folder, manifest)
    if not retry:  # else what is tried again finds the rest
        remove_parts(folder)
    return manifest
