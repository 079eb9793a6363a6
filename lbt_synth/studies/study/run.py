"""Run a study, or what is missing of it, and write its results; estimate what it will cost."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.storage.atomic_files import exclusive_lock, make_directory, refuse_replacing
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.thread_limits import limit_threads
from lbt_synth.storage.worker_processes import WorkerPool
from lbt_synth.studies.study import store
from lbt_synth.studies.study.batch_evaluation import are_evaluated_together, evaluate_samples
from lbt_synth.studies.study.engine import (
    Evaluate,
    InlineExecutor,
    TimedBatch,
    cut_parts,
    evaluate_parts,
)
from lbt_synth.studies.study.store import read_results, write_failures, write_results
from lbt_synth.studies.study.study import Failure, Study
from lbt_synth.validation import FloatArray, integer, require_instance

_MOST_JOBS = 64
# Rows of a part whose samples are evaluated together: some tenths of a second, of which the check
# of one sample by itself is a fifth (benchmarks/study_rates.py would be slower with fewer). Where
# each sample takes milliseconds or seconds, a killed study shall lose few of them.
_ROWS_TOGETHER, _ROWS_ONE_BY_ONE = 8192, 16
_PARTS_PER_WORKER = 4  # at least, so that none waits long for the last
_IN_FLIGHT = 2  # parts per worker, so that none waits for the next
_MEASURED_ROWS = 4  # of the first batch of an estimate, and the growth of the next ones
_LONG_ENOUGH_S = 1.0
_NUMBER_BYTES, _PART_BYTES = 13, 8  # of a result in the table and in a part


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinishedStudy:
    """All results of a finished study."""

    columns: dict[str, FloatArray]  # by name, (n,) each
    computing_s: float  # time of all batches, summed over processes [s]
    new: bool  # whether some were computed now; else all were read from the table


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyRun:
    """What a run of a study did."""

    directory: Path  # directory, table of results and table of failures
    results: Path
    failed: Path
    samples: int  # rows of the results
    computed: int  # how many of them this run computed
    failures: int  # controllers of samples that have no result
    computing_s: float  # time of this run until the last row was computed, and to its end [s]
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a study will cost."""

    measured_rows: int  # rows of the batch that was measured
    measured_s: float  # time that it took in one process [s]
    seconds: float  # time of the whole study on the requested processes [s]
    disk_bytes: int  # largest size of its directory, while it holds both results and parts


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

    Every part, a fixed number of rows, is a file in ``parts`` as soon as it is computed, written
    completely or not at all: a study that is killed at any moment, or whose worker died, resumes
    where it was. When all rows are computed, ``results.csv`` is written with one row per sample in
    order, and ``failed.csv`` with the failures; then the parts are removed.

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
        ``evaluate(study, values, start)`` returns the :class:`BatchResult` of rows of
        ``study.values``. Other processes must be able to import it by name.
    progress : callable, optional
        Called with the number of rows that were found or finished since its last call.
    whole : callable, optional
        Called with all results when all rows are computed. The manifest records the end of the
        study only after it, so that a call that fails is repeated. A study that was finished
        before calls it, too.

    Returns
    -------
    StudyRun
        What was done. A finished study is not run again.

    Raises
    ------
    ProblemError
        If there are too many or too few jobs.
    OutputError
        If the directory belongs to another study, is in use or cannot be written, files in it
        would be replaced, or its results were changed.
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
    >>> run.results.name, run.computed, again.computed
    ('results.csv', 4, 0)
    """
    require_instance(study, Study)
    jobs = integer(jobs, "jobs", at_least=1)
    most = max(_MOST_JOBS, 8 * (os.cpu_count() or 1))
    if jobs > most:
        raise ProblemError(f"jobs must be at most {most} on this machine; got {jobs}.")
    if executor is not None:
        at_once = workers or getattr(executor, "_max_workers", None) or os.cpu_count() or 1
        jobs = integer(at_once, "workers", at_least=1)
    folder = Path(directory)
    refuse_replacing(output_paths(folder, study), study.inputs)
    began = time.perf_counter()
    computed, computing_s = 0, 0.0
    count = progress or (lambda rows: None)
    with exclusive_lock(folder, "study"):
        store.remove_unfinished(folder)
        manifest = _begin(folder, study)
        if manifest.finished:
            store.remove_parts(folder)  # a run was killed while it removed them
            count(study.samples)
            if whole is not None:
                columns, spent = read_results(folder, study), manifest.computing_seconds
                whole(FinishedStudy(columns=columns, computing_s=spent, new=False))
        else:
            log, missing = _read_parts(study, folder)
            computed = sum(stop - start for start, stop in missing)
            if computed < study.samples:
                count(study.samples - computed)
            if missing:
                with _choose_executor(executor, jobs) as chosen:
                    parts = cut_parts(missing, _part_rows(study, jobs))
                    in_flight = 1 if isinstance(chosen, InlineExecutor) else _IN_FLIGHT * jobs
                    batches = evaluate_parts(study, parts, evaluate, chosen, in_flight=in_flight)
                    _write_parts(study, folder, batches, log, count)
            computing_s = time.perf_counter() - began
            manifest = _write_tables(folder, study, manifest, log, began, whole)
    return StudyRun(
        directory=folder,
        results=folder / store.RESULTS,
        failed=folder / store.FAILED,
        samples=study.samples,
        computed=computed,
        failures=manifest.failures,
        computing_s=computing_s,
        seconds=time.perf_counter() - began,
    )


@contextlib.contextmanager
def _choose_executor(executor: Executor | None, jobs: int) -> Iterator[Executor]:
    """Provide the caller's executor, new processes with one thread each, or this process."""
    with ExitStack() as environment:
        if executor is None and jobs > 1:
            environment.enter_context(limit_threads())
            executor = environment.enter_context(WorkerPool(jobs))
        yield executor or InlineExecutor()


def _part_rows(study: Study, workers: int) -> int:
    """Return the number of rows of a part."""
    together = all(are_evaluated_together(study, each) for each in study.controllers)
    share = -(-study.samples // (_PARTS_PER_WORKER * workers))
    return min(_ROWS_TOGETHER if together else _ROWS_ONE_BY_ONE, share)


def output_paths(folder: Path, study: Study) -> list[Path]:
    """Return the files that a study writes into its directory, without its parts."""
    designs = [f"{c.name}.fits" for c in study.controllers if c.is_designed]
    tables = [store.RESULTS, store.FAILED, store.PAGE, store.PRINT]
    return [folder / name for name in (store.MANIFEST, *tables, *designs)]


def _begin(folder: Path, study: Study) -> store.Manifest:
    """Return the manifest of a directory; begin the study if there is none."""
    manifest = store.read_manifest(folder, study.digest)
    if manifest is not None:
        store.read_designs(folder, manifest)
        if manifest.finished:
            if all((folder / name).exists() for name in (store.RESULTS, store.FAILED)):
                store.require_unchanged(folder, manifest)
            else:
                manifest = manifest.write(folder, finished=False, tables={})
    else:
        if store.list_parts(folder):
            why = f"holds parts of a study without its {store.MANIFEST}. Name another directory, or"
            store.refuse(folder, f"{why} delete {folder / store.PARTS}.")
        for path in output_paths(folder, study):
            if path.exists():
                why = "is not of a study in this directory, and would be replaced. Name another"
                store.refuse(path, f"{why} directory, or delete it.")
        manifest = store.new_manifest(study).write(folder)
    if set(manifest.designs) != {c.name for c in study.controllers if c.is_designed}:
        # begun now, or killed before they were written
        manifest = manifest.write(folder, designs=store.write_designs(folder, study))
    return manifest


@dataclass(slots=True)
class _Log:
    """What all parts say of their results."""

    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0  # of their batches

    def add(self, failures: Sequence[Failure], seconds: float) -> None:
        """Add what one part says."""
        self.failures.extend(failures)
        self.seconds += seconds


def _read_parts(study: Study, folder: Path) -> tuple[_Log, list[store.RowRange]]:
    """Return what the parts of earlier runs say, and the rows that none of them has."""
    log, parts = _Log(), store.list_parts(folder)
    for part in parts:
        _, failures, seconds = store.read_part(part, study)
        log.add(failures, seconds)
    return log, store.missing_rows(parts, study.samples)


def _write_parts(
    study: Study,
    folder: Path,
    batches: Generator[TimedBatch, None, None],
    log: _Log,
    progress: Callable[[int], None],
) -> None:
    """Write each part as it comes."""
    if make_directory(folder / store.PARTS).is_symlink():
        path = folder / store.PARTS
        raise OutputError(f"cannot make the directory {path}: it is a link.", path=folder)
    with contextlib.closing(batches):
        for batch, seconds in batches:
            part = store.write_part(folder, study, batch, seconds)
            log.add(batch.failures, seconds)
            progress(part.stop - part.start)


def _write_tables(
    folder: Path,
    study: Study,
    manifest: store.Manifest,
    log: _Log,
    began: float,
    whole: Callable[[FinishedStudy], None] | None,
) -> store.Manifest:
    """Write the results of all parts, then the manifest, then remove the parts."""
    parts = store.list_parts(folder)
    tables = write_results(folder, study, parts), write_failures(folder, log.failures)
    if whole is not None:
        columns = read_results(folder, study, parts)
        whole(FinishedStudy(columns=columns, computing_s=log.seconds, new=True))
    manifest = manifest.write(
        folder,
        finished=True,
        tables={path.name: file_sha256(path, OutputError) for path in tables},
        failures=len(log.failures),
        seconds=manifest.seconds + time.perf_counter() - began,
        computing_seconds=log.seconds,
    )
    store.remove_parts(folder)
    return manifest


def estimate_study(
    study: Study, *, workers: int = 1, local: bool = True, evaluate: Evaluate = evaluate_samples
) -> Estimate:
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
    Estimate
        The estimate.

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
        before = time.perf_counter()
        evaluate(study, values, start)
        seconds, rows = time.perf_counter() - before, len(values)
        start, size = start + rows, _MEASURED_ROWS * size
    at_once = min(workers, os.cpu_count() or 1) if local else workers
    table = _NUMBER_BYTES * len(study.columns)
    parts = _PART_BYTES * len(study.result_columns)
    return Estimate(
        measured_rows=rows,
        measured_s=seconds,
        seconds=seconds / rows * study.samples / at_once,
        disk_bytes=study.samples * (table + parts),
    )
