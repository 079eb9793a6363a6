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
from lbt_synth.errors import OutputError
from lbt_synth.files import refuse_replacing
from lbt_synth.processes import alone_in
from lbt_synth.study.batch import evaluate_samples
from lbt_synth.study.engine import Evaluate, run_batches
from lbt_synth.study.parquet import require_parquet
from lbt_synth.study.results import (
    failures_in,
    read_results,
    results_path,
    write_failures,
    write_results,
)
from lbt_synth.study.store import (
    FAILED,
    MANIFEST,
    PARTS,
    Part,
    missing_rows,
    part_list,
    read_manifest,
    read_part,
    remove_parts,
    require_same,
    stored_design,
    write_designs,
    write_manifest,
    write_part,
)
from lbt_synth.study.study import Study
from lbt_synth.validation import FloatArray, instance, integer


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
    whole: Callable[[dict[str, FloatArray]], None] | None = None,
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
        Processes, if there is no executor; 1 runs in this one.
    workers : int, optional
        How many batches the executor runs at once, as far as it does not tell; twice as many are
        in flight.
    evaluate : callable, optional
        ``evaluate(study, values, start)`` returns the :class:`BatchResult` of rows of
        ``study.values``; importable by name where other processes run it.
    progress : callable, optional
        Called with the number of rows that were found or finished since its last call.
    whole : callable, optional
        Called with all columns, each under its name, when all rows are there: before the manifest
        says so, so that what it does is done again if it fails.

    Returns
    -------
    StudyRun
        What was done. A study that is finished is not run again.

    Raises
    ------
    OutputError
        If the directory is of another study, is in use, or cannot be written.
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
    ...     run = lbt.run_study(lbt.load_study(folder / "small.yaml"), folder)
    ...     again = lbt.run_study(lbt.load_study(folder / "small.yaml"), folder)
    >>> run.results.name, run.computed, again.computed
    ('results.csv', 4, 0)
    """
    instance(study, Study)
    jobs = integer(jobs, "jobs", at_least=1)
    if executor is not None:
        known = workers or getattr(executor, "_max_workers", None) or os.cpu_count() or 1
        workers = integer(known, "workers", at_least=1)
    folder = Path(directory)
    if study.settings.results == "parquet":
        require_parquet()
    refuse_replacing(written_files(folder, study), study.inputs)
    began = time.perf_counter()
    with alone_in(folder, "study"):
        manifest = _begun(folder, study)
        finished = bool(manifest["finished"]) and results_path(folder, study).exists()
        parts = _usable_parts(folder, study)
        if finished and not manifest["retry"]:
            remove_parts(folder)  # killed while it removed them
            parts = []
        computed, computing_s = 0, 0.0
        if not finished or manifest["retry"]:
            computed = _complete(
                study, folder, parts, executor=executor, jobs=jobs, workers=workers,
                evaluate=evaluate, progress=progress,
            )  # fmt: skip
            computing_s = time.perf_counter() - began
            manifest = _written(folder, study, manifest, computed, began, whole)
        elif progress is not None:
            progress(study.samples)
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


def written_files(folder: Path, study: Study) -> list[Path]:
    """Return the files that a study writes into its directory, but for its parts."""
    made = [c.name for c in study.controllers if c.request is not None and c.design is not None]
    names = [MANIFEST, FAILED, results_path(folder, study).name, *(f"{n}.fits" for n in made)]
    return [folder / name for name in names]


def _begun(folder: Path, study: Study) -> dict[str, Any]:
    """Return the manifest of a directory, of a new study if there is none."""
    manifest = read_manifest(folder)
    if manifest is not None:
        require_same(manifest, study.digest, folder)
        for name in manifest["designs"]:
            stored_design(folder, name, manifest)
    elif part_list(folder):
        raise OutputError(
            f"{folder} holds parts of a study without its {MANIFEST}. Name another directory, or "
            f"delete {folder / PARTS}.",
            path=folder,
        )
    else:
        manifest = {
            "digest": study.digest,
            "version": lbt_synth.__version__,
            "source": str(study.source),
            "samples": study.samples,
            "evaluation": study.settings.evaluation,
            "parameters": {p.name: p.distribution.text for p in study.parameters},
            "controllers": {c.name: c.origin for c in study.controllers},
            "designs": write_designs(folder, study),
            "settings": study.settings.model_dump(by_alias=True, exclude_none=True),
            "finished": False,
            "failures": 0,
            "retry": 0,
            "seconds": 0.0,
            "computing_seconds": 0.0,
        }
        write_manifest(folder, manifest)
    return manifest


def _usable_parts(folder: Path, study: Study) -> list[Part]:
    """Return the parts that need not be computed again; those that are to be are removed."""
    usable = []
    for part in part_list(folder):
        failures = read_part(part, study)[1]
        if any(failure.retry for failure in failures):  # a single row, see the engine
            part.path.unlink()
        else:
            usable.append(part)
    return usable


def _complete(
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


def _written(
    folder: Path,
    study: Study,
    manifest: dict[str, Any],
    computed: int,
    began: float,
    whole: Callable[[dict[str, FloatArray]], None] | None,
) -> dict[str, Any]:
    """Write the results of all parts, then the manifest, then remove the parts."""
    parts = part_list(folder)
    failures = failures_in(study, parts)
    write_results(folder, study, parts)
    write_failures(folder, failures)
    if whole is not None:
        whole(read_results(folder, study, parts))
    retry = sum(failure.retry for failure in failures)
    spent = sum(read_part(part, study)[2] for part in parts)
    manifest = manifest | {
        "finished": True,
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
