"""Run the batches of a study on any executor, and recover when a process dies."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lbt_synth.errors import LbtSynthError, NumericalError
from lbt_synth.storage.worker_processes import WorkerPool, limit_threads
from lbt_synth.studies.study.batch_queue import BatchQueue
from lbt_synth.studies.study.batch_result import BatchResult, Failure
from lbt_synth.studies.study.cluster import is_death_of_workers
from lbt_synth.studies.study.store import RowRange
from lbt_synth.studies.study.study import Study
from lbt_synth.validation import FloatArray

Evaluate = Callable[[Study, FloatArray, int], BatchResult]
TimedBatch = tuple[BatchResult, float]  # with its seconds

DIED = "its process ended without a word: killed, or for want of memory"
_MOST_DEATHS = 40  # in a row, without a batch that comes back
_IN_FLIGHT = 2  # batches per worker, so that none waits


@dataclass(frozen=True, slots=True)
class _Task:
    rows: RowRange
    alone: bool


class _InlineExecutor(Executor):
    """Executor that runs each call at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Workers:
    """An executor: that of the caller, one in this process, or a pool that can be renewed."""

    def __init__(self, jobs: int, executor: Executor | None) -> None:
        self._jobs = jobs
        self._pool = WorkerPool(jobs) if executor is None and jobs > 1 else None
        self.executor = self._pool.executor if self._pool else executor or _InlineExecutor()

    def renew(self, error: BaseException) -> None:
        """Start new processes after some died."""
        if self._pool is None:
            raise NumericalError(
                f"the executor broke: {error or type(error).__name__}. What is finished is kept: "
                "start again, with a new executor."
            ) from error
        self._pool.close()
        self._pool = WorkerPool(self._jobs)
        self.executor = self._pool.executor

    def __enter__(self) -> _Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is not None and kind is not None:
            self._pool.kill()
        elif self._pool is not None:
            self._pool.close()


def evaluate_timed(evaluate: Evaluate, study: Study, values: FloatArray, start: int) -> TimedBatch:
    """Evaluate a batch and time it, in the worker."""
    before = time.perf_counter()
    batch = evaluate(study, values, start)
    return batch, time.perf_counter() - before


def run_batches(
    study: Study,
    ranges: Sequence[RowRange],
    *,
    evaluate: Evaluate,
    jobs: int = 1,
    executor: Executor | None = None,
    workers: int | None = None,
) -> Generator[TimedBatch, None, None]:
    """Yield the results of all rows of some ranges, in the order in which they arrive.

    When a process dies, all batches in flight run again, each alone. One that kills its process
    again is halved, down to single rows, which fail.
    """
    run = _BatchRun(study, evaluate, BatchQueue(ranges, workers or jobs))
    most = 1 if executor is None and jobs == 1 else _IN_FLIGHT * (workers or jobs)
    own = executor is None and jobs > 1
    with limit_threads() if own else nullcontext(), _Workers(jobs, executor) as engine:
        try:
            while run.queue.left or run.suspects or run.running:
                broken = run.submit(engine.executor, most)
                dead: list[_Task] = []
                for task, future in run.wait():
                    raised = _future_error(future)
                    if raised is None:
                        yield run.receive(task, future)
                        continue
                    if isinstance(raised, BrokenExecutor):
                        broken = raised
                    elif not is_death_of_workers(raised):
                        raise _error_to_raise(raised, task.rows)
                    dead.append(task)
                if broken is not None:
                    dead += run.running.values()
                    run.running.clear()
                    engine.renew(broken)
                if dead or broken is not None:
                    run.count_death()
                for row in run.suspect(dead):
                    yield _failed_row(study, row), 0.0
        finally:
            for future in run.running:
                future.cancel()


@dataclass(slots=True)
class _BatchRun:
    """Where the batches of a run are: in the queue, on a worker, or suspected of killing it."""

    study: Study
    evaluate: Evaluate
    queue: BatchQueue
    running: dict[Future[TimedBatch], _Task] = field(default_factory=dict)
    suspects: deque[RowRange] = field(default_factory=deque)
    deaths: int = 0  # since a batch came back

    def submit(self, executor: Executor, most: int) -> BrokenExecutor | None:
        """Keep the workers busy, or run one suspect alone; return what broke the executor."""
        while (self.queue.left and not self.suspects and len(self.running) < most) or (
            self.suspects and not self.running
        ):
            alone = bool(self.suspects)
            rows = self.suspects[0] if alone else self.queue.take()
            values = self.study.values(*rows)
            try:
                future = executor.submit(evaluate_timed, self.evaluate, self.study, values, rows[0])
            except BrokenExecutor as error:
                if not alone:
                    self.suspects.append(rows)  # taken from the queue, but not run
                return error
            if alone:
                self.suspects.popleft()
            self.running[future] = _Task(rows=rows, alone=alone)
        return None

    def wait(self) -> Iterator[tuple[_Task, Future[TimedBatch]]]:
        """Wait for a batch, and yield each one that has ended."""
        if self.running:
            done, _ = wait(self.running, return_when=FIRST_COMPLETED)
            for future in done:
                yield self.running.pop(future), future

    def receive(self, task: _Task, future: Future[TimedBatch]) -> TimedBatch:
        """Return a batch that came back, with its seconds."""
        self.deaths = 0
        batch, seconds = future.result()
        _require_whole(batch, task.rows, self.study)
        self.queue.learn(task.rows[1] - task.rows[0], seconds)
        return batch, seconds

    def count_death(self) -> None:
        """Count the death of a process, and refuse to go on after too many in a row."""
        self.deaths += 1
        if self.deaths > _MOST_DEATHS:
            raise NumericalError(
                f"{self.deaths} times one after the other a process ended without a word, for want "
                "of memory perhaps. What is finished is kept: start again, with fewer jobs."
            )

    def suspect(self, dead: Sequence[_Task]) -> Iterator[int]:
        """Let batches run again, each alone, or in halves; yield single rows that failed alone."""
        for task in sorted(dead, key=lambda task: task.rows):
            start, stop = task.rows
            if not task.alone:
                self.suspects.append(task.rows)
            elif stop - start == 1:
                yield start
            else:
                middle = (start + stop) // 2
                self.suspects.extendleft([(middle, stop), (start, middle)])


def _future_error(future: Future[TimedBatch]) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _error_to_raise(error: BaseException, rows: RowRange) -> BaseException:
    """Return the error to raise where a batch as a whole failed."""
    if isinstance(error, LbtSynthError | MemoryError):
        return error
    if isinstance(error, CancelledError):
        raised = NumericalError(
            "the executor cancelled what was running: its scheduler is gone, perhaps. What is "
            "finished is kept: start again."
        )
    else:
        text = f"{type(error).__name__}: {error}".rstrip(".")
        raised = NumericalError(
            f"rows {rows[0]} to {rows[1] - 1} could not be computed ({text}). What is finished is "
            "kept. Every process needs the same lbt_synth as this one."
        )
    raised.__cause__ = error
    return raised


def _require_whole(batch: BatchResult, rows: RowRange, study: Study) -> None:
    """Refuse a batch that has not the requested rows and columns."""
    size = rows[1] - rows[0]
    if not (
        isinstance(batch, BatchResult)
        and batch.start == rows[0]
        and tuple(batch.columns) == study.result_columns
        and all(np.shape(column) == (size,) for column in batch.columns.values())
    ):
        raise NumericalError(
            f"the evaluation must return a BatchResult of rows {rows[0]} to {rows[1] - 1} with the "
            "columns of the study, in their order; got something else."
        )


def _failed_row(study: Study, row: int) -> BatchResult:
    """Return the batch of a row that ends its process."""
    return BatchResult(
        start=row,
        columns={name: np.full(1, np.nan) for name in study.result_columns},
        failures=tuple(
            Failure(row=row, controller=controller.name, error=DIED, retry=True)
            for controller in study.controllers
        ),
    )
