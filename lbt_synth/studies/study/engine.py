"""Run a study in batches that are long enough, on any executor, and recover from dead processes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent import futures
from contextlib import ExitStack, suppress
from functools import partial
from typing import Any

import numpy as np

from lbt_synth.errors import LbtSynthError, NumericalError
from lbt_synth.storage.thread_limits import limit_threads
from lbt_synth.storage.worker_processes import WorkerPool
from lbt_synth.studies.study.store import RowRange
from lbt_synth.studies.study.study import BatchResult, Failure, Study
from lbt_synth.validation import FloatArray

FIRST_ROWS = 4
MOST_ROWS = 65_536
GROWTH = 4  # of a batch over a measured one, at most
_SECONDS = 1.5  # long compared with the milliseconds of a task, short enough to wait for
_TRIAL_SECONDS = 6.0  # of the second size, before the cost of a row is known
_OVER_FIXED = 19  # the time that does not grow with the rows is a twentieth of a batch
_CRUMB_SECONDS = 0.1  # towards the end, no batch is shorter
_MOST_PARTS = 4000  # a long study has longer batches rather than more files
DIED = "its process died: killed, or out of memory"
_DASK_DEATH = "KilledWorker"  # the error of Dask where every worker that tried a batch died
_MOST_DEATHS = 40  # in a row, without a batch that comes back
_IN_FLIGHT = 2  # batches per worker, so that none waits


class BatchQueue:
    """Ranges of rows that are still to be computed, taken in batches by a number of workers."""

    def __init__(self, ranges: Sequence[RowRange], workers: int) -> None:
        self._ranges = deque(ranges)
        self._workers = workers
        self._small: tuple[int, float] | None = None  # rows and seconds of the smallest batch
        self._best: tuple[int, float] | None = None  # and of the one with the least time per row
        self._least_s = float("inf")  # of all batches
        self.left = sum(stop - start for start, stop in ranges)

    def take(self) -> RowRange:
        """Take the next batch, and return its rows."""
        start, end = self._ranges[0]
        stop = min(end, start + self._size())
        if stop == end:
            self._ranges.popleft()
        else:
            self._ranges[0] = (stop, end)
        self.left -= stop - start
        return start, stop

    def learn(self, rows: int, seconds: float) -> None:
        """Record how long a batch took."""
        seconds = max(seconds, 1e-9)
        self._least_s = min(self._least_s, seconds)
        if self._small is None or (rows, seconds) < self._small:
            self._small = rows, seconds
        if self._best is None or seconds / rows <= self._best[1] / self._best[0] * (1 + 1e-9):
            self._best = rows, seconds

    def _size(self) -> int:
        share = -(-self.left // (2 * self._workers))  # towards the end, some for every worker
        if self._small is None or self._best is None:
            return max(1, min(FIRST_ROWS, share))
        (few, short), (many, long) = self._small, self._best
        if few == many:
            return max(1, min(int(many * min(GROWTH, _TRIAL_SECONDS / long)), share))
        slope = max(long - short, 0.0) / (many - few)
        # the first batch includes the warm-up
        fixed_s = max(min(short - few * slope, self._least_s), 0.0)
        row_s = max(long - fixed_s, 1e-3 * long) / many
        target_s = max(_SECONDS, _OVER_FIXED * fixed_s, self.left * row_s / _MOST_PARTS)
        most = min(int(target_s / row_s), GROWTH * many, MOST_ROWS)
        crumb = int(max(_CRUMB_SECONDS, 4 * fixed_s) / row_s) if _CRUMB_SECONDS else 0
        crumb = min(crumb, -(-self.left // self._workers))
        return max(1, min(most, max(share, crumb)))


Evaluate = Callable[[Study, FloatArray, int], BatchResult]
TimedBatch = tuple[BatchResult, float]  # with its seconds


class _InlineExecutor(futures.Executor):
    """Executor that runs each call at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> futures.Future[Any]:
        future: futures.Future[Any] = futures.Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Workers:
    """What evaluates batches: the caller's executor, this process, or a pool of its own.

    ``workers`` says how many batches run at once, where an executor is given.
    """

    def __init__(
        self,
        study: Study,
        *,
        evaluate: Evaluate,
        jobs: int = 1,
        executor: futures.Executor | None = None,
        workers: int | None = None,
    ) -> None:
        self._study, self._jobs = study, jobs
        self._call = partial(evaluate_timed, evaluate, study)
        self._executor = executor or _InlineExecutor()
        self._is_own = executor is None and jobs > 1
        self._broken: futures.BrokenExecutor | None = None
        self._deaths = 0  # in a row
        self._environment = ExitStack()
        self.at_once = jobs if executor is None else workers or jobs
        self.in_flight = 1 if executor is None and jobs == 1 else _IN_FLIGHT * self.at_once

    def __enter__(self) -> Workers:
        if self._is_own:
            self._environment.enter_context(limit_threads())
            self._executor = WorkerPool(self._jobs)
            for _ in range(self._jobs):  # all processes start now, and load what they need
                self._executor.submit(_load, self._call)
        return self

    def __exit__(self, *error: Any) -> None:
        with self._environment:
            if self._is_own:
                self._executor.__exit__(*error)

    def begin(self, call: Callable[..., Any], *args: Any) -> Callable[[], Any]:
        """Begin a call in a process of its own pool; return a function that waits for its result.

        Without a pool it runs at once, and where its process dies it runs again in this one.
        """
        if not self._is_own:
            found = call(*args)
            return lambda: found

        def wait() -> Any:
            with suppress(futures.BrokenExecutor):
                return future.result()
            return call(*args)

        try:
            future = self._executor.submit(call, *args)
        except futures.BrokenExecutor:
            return partial(call, *args)
        return wait

    def submit(self, rows: RowRange) -> futures.Future[TimedBatch]:
        """Begin to evaluate some rows."""
        try:
            return self._executor.submit(self._call, self._study.values(*rows), rows[0])
        except futures.BrokenExecutor as error:
            lost: futures.Future[TimedBatch] = futures.Future()
            lost.set_exception(error)
            return lost

    def receive(self, future: futures.Future[TimedBatch], rows: RowRange) -> TimedBatch | None:
        """Wait for a batch and return it, None if its process died."""
        try:
            batch = future.result()
        except futures.BrokenExecutor as error:
            self._broken = error
            return None
        except Exception as error:
            if type(error).__name__ == _DASK_DEATH:
                return None
            if isinstance(error, LbtSynthError | MemoryError):
                raise
            raise NumericalError(_describe_failure(error, rows)) from error
        finally:
            future.cancel()  # where the wait is interrupted
        self._deaths = 0
        _require_whole(batch[0], rows, self._study)
        return batch

    def failed_row(self, row: int) -> TimedBatch:
        """Return the batch of a row that ends its process."""
        failures = [
            Failure(row=row, controller=controller.name, error=DIED, retry=True)
            for controller in self._study.controllers
        ]
        columns = {name: np.full(1, np.nan) for name in self._study.result_columns}
        return BatchResult(start=row, columns=columns, failures=tuple(failures)), 0.0

    def recover(self) -> None:
        """Start new processes after some died; refuse to go on after too many deaths in a row."""
        error, self._broken = self._broken, None
        if error is not None:
            if not self._is_own:
                raise NumericalError(
                    f"the executor broke: {error or type(error).__name__}. What is finished is "
                    "kept: start again, with a new executor."
                ) from error
            self._executor.shutdown()
            self._executor = WorkerPool(self._jobs)
        self._deaths += 1
        if self._deaths > _MOST_DEATHS:
            raise NumericalError(
                f"{self._deaths} times in a row a process died, perhaps out of memory. What is "
                "finished is kept. Start again with fewer jobs."
            )


def evaluate_timed(evaluate: Evaluate, study: Study, values: FloatArray, start: int) -> TimedBatch:
    """Evaluate a batch and time it, in the worker."""
    before = time.perf_counter()
    batch = evaluate(study, values, start)
    return batch, time.perf_counter() - before


def _load(call: Callable[..., Any]) -> None:
    """Do nothing with a call; the process that got it has loaded what it needs."""


def run_batches(engine: Workers, ranges: Sequence[RowRange]) -> Generator[TimedBatch, None, None]:
    """Yield the results of all rows of some ranges, in the order in which they arrive.

    When a process dies, all batches in flight run again, each alone. One that kills its process
    again is halved, down to single rows, which fail.
    """
    queue = BatchQueue(ranges, engine.at_once)
    while queue.left:
        for rows in (yield from _run_until_death(engine, queue)):
            yield from _run_alone(engine, rows)


def _run_until_death(
    engine: Workers, queue: BatchQueue
) -> Generator[TimedBatch, None, list[RowRange]]:
    """Yield the batches of a queue until a process dies, and return those that were lost."""
    running: dict[futures.Future[TimedBatch], RowRange] = {}
    dead: list[RowRange] = []
    try:
        while running or (queue.left and not dead):
            while queue.left and not dead and len(running) < engine.in_flight:
                rows = queue.take()
                running[engine.submit(rows)] = rows
            for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                rows = running.pop(future)
                batch = engine.receive(future, rows)
                if batch is None:
                    dead.append(rows)
                    continue
                queue.learn(rows[1] - rows[0], batch[1])
                yield batch
    finally:
        for future in running:
            future.cancel()
    if dead:
        engine.recover()
    return sorted(dead)


def _run_alone(engine: Workers, rows: RowRange) -> Iterator[TimedBatch]:
    """Yield the results of rows of which one may have killed a process, in halves if it does."""
    batch = engine.receive(engine.submit(rows), rows)
    if batch is not None:
        yield batch
        return
    engine.recover()
    start, stop = rows
    if stop - start == 1:
        yield engine.failed_row(start)
        return
    middle = (start + stop) // 2
    for half in ((start, middle), (middle, stop)):
        yield from _run_alone(engine, half)


def _describe_failure(error: Exception, rows: RowRange) -> str:
    """Return what to say where a batch as a whole failed."""
    kept = "What is finished is kept"
    if isinstance(error, futures.CancelledError):
        why = "the executor cancelled what was running: its scheduler is gone, perhaps"
        return f"{why}. {kept}: start again."
    text = f"{type(error).__name__}: {error}".rstrip(".")
    return (
        f"rows {rows[0]} to {rows[1] - 1} could not be computed ({text}). {kept}. Every process "
        "needs the same lbt_synth as this one."
    )


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
