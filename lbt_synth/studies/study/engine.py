"""Evaluate the parts of a study, on any executor."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent import futures
from contextlib import contextmanager
from itertools import islice
from typing import Any

import numpy as np

from lbt_synth.errors import LbtSynthError, NumericalError
from lbt_synth.studies.study.store import RowRange
from lbt_synth.studies.study.study import BatchResult, Study
from lbt_synth.validation import FloatArray

Evaluate = Callable[[Study, FloatArray, int], BatchResult]
TimedBatch = tuple[BatchResult, float]  # with its seconds


class InlineExecutor(futures.Executor):
    """Executor that runs each call at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> futures.Future[Any]:
        """Run a call; its error is that of the future."""
        future: futures.Future[Any] = futures.Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def cut_parts(ranges: Sequence[RowRange], rows: int) -> Iterator[RowRange]:
    """Yield the parts of some ranges: a number of rows each, and less at the end of a range."""
    for start, stop in ranges:
        for first in range(start, stop, rows):
            yield first, min(first + rows, stop)


def evaluate_parts(
    study: Study,
    parts: Iterator[RowRange],
    evaluate: Evaluate,
    executor: futures.Executor,
    *,
    in_flight: int,
) -> Generator[TimedBatch, None, None]:
    """Yield the results of parts in the order in which they come, a few of them in flight."""
    running: dict[futures.Future[TimedBatch], RowRange] = {}
    try:
        while True:
            for rows in islice(parts, in_flight - len(running)):
                with _explain_failure(rows):
                    values = study.values(*rows)
                    future = executor.submit(evaluate_timed, evaluate, study, values, rows[0])
                running[future] = rows
            if not running:
                return
            for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                rows = running.pop(future)
                with _explain_failure(rows):
                    batch = future.result()
                _require_whole(batch[0], rows, study)
                yield batch
    finally:
        for future in running:
            future.cancel()


def evaluate_timed(evaluate: Evaluate, study: Study, values: FloatArray, start: int) -> TimedBatch:
    """Evaluate a part and time it, in the worker."""
    before = time.perf_counter()
    batch = evaluate(study, values, start)
    return batch, time.perf_counter() - before


@contextmanager
def _explain_failure(rows: RowRange) -> Iterator[None]:
    """Say what to do where a part as a whole fails, or its worker dies."""
    try:
        yield
    except (LbtSynthError, MemoryError):
        raise
    except Exception as error:
        text = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": .")
        raise NumericalError(
            f"rows {rows[0]} to {rows[1] - 1} have no result ({text}): a process died, perhaps out "
            "of memory, or has another lbt_synth than this one. What is finished is kept: start "
            "the study again, perhaps with fewer jobs, and it goes on from there."
        ) from error


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
