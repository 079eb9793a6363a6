"""A grid of many samples: a function of some of them, an executor, and parts on disk.

What a loop leaves has the same columns for one loop and for a stack of them. Answers that fit on a
page are kept in memory (:func:`evaluate`). A part of a :class:`Sweep` is a file of the results of
consecutive rows; a sweep that was killed goes on with the rows that no part has.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent import futures
from dataclasses import dataclass
from itertools import islice, pairwise, starmap
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

import numpy as np

from lbt_synth.errors import LbtSynthError, NumericalError, OutputError
from lbt_synth.loop import ClosedLoop, Imaging, residual_budget, strehl
from lbt_synth.loop.budget import ResidualBudget, ensemble_residuals
from lbt_synth.loop.ensemble import LoopEnsemble
from lbt_synth.loop.evaluator import Matrices
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.storage import array_file
from lbt_synth.storage.atomic_files import (
    UNFINISHED,
    exclusive_lock,
    make_directory,
    write_atomically,
)
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import FloatArray

Answer = TypeVar("Answer")
Rows = tuple[int, int]  # the first, and the one after the last
Failure = tuple[int, str, str]  # a row, the controller without a result on it, and why
Result = tuple[dict[str, FloatArray], list[Failure]]  # columns of some rows (b,), and failures
RESIDUALS = {"residual_nm": "rms_nm"} | {  # columns, and the attributes of what has them
    name: name for name in ("turbulence_nm", "vibration_nm", "noise_nm", "within_nm")
}
_PART = re.compile(r"([0-9]{10})-([0-9]{10})\.npz")
_DELETE = "Delete it, and it is computed again."


def loop_columns(
    loop: ClosedLoop, truth: Truth, imaging: Imaging, *, frame_means: bool = False
) -> dict[str, float]:
    """Return what a loop leaves in a truth, by column; nan where it is unstable."""
    if not loop.is_stable:
        return {"stable": 0.0} | dict.fromkeys(("strehl", *RESIDUALS), np.nan)
    return residual_columns(residual_budget(loop, truth, frame_means=frame_means), imaging)


def residual_columns(budget: ResidualBudget, imaging: Imaging) -> dict[str, Any]:
    """Return what a loop or p of them leave, by column (p,); nan where one is unstable."""
    columns = {column: getattr(budget, name) for column, name in RESIDUALS.items()}
    return {"stable": budget.stable * 1.0, "strehl": strehl(budget, imaging)} | columns


def evaluate(
    function: Callable[..., Answer],
    samples: Iterable[Sequence[Any]],
    executor: futures.Executor | None = None,
) -> Iterator[Answer]:
    """Yield a function of the arguments of each sample, in their order.

    An executor has all samples at once; without one, each is evaluated when it is requested.
    """
    if executor is None:
        yield from starmap(function, samples)
        return
    running: list[futures.Future[Answer]] = []
    try:
        running += [executor.submit(function, *sample) for sample in samples]
        for future in running:
            yield future.result()
    except Exception as error:
        dead = isinstance(error, futures.BrokenExecutor | futures.CancelledError)
        if not dead and type(error).__name__ != "KilledWorker":  # that of Dask
            raise
        died = f"a worker of the executor died ({type(error).__name__}), perhaps out of memory"
        raise NumericalError(f"{died}. Start it again, perhaps with fewer workers.") from error
    finally:
        for future in running:
            future.cancel()


def ensemble_columns(
    matrices: Matrices, hardware: LoopHardware, ensemble: LoopEnsemble, imaging: Imaging
) -> dict[str, Any]:
    """Return what controllers A, B, C, D leave in many loops, by column (p,)."""
    return residual_columns(ensemble_residuals(matrices, hardware, ensemble), imaging)


class Part(NamedTuple):
    """The results of some rows (b, columns), what failed, and the time that they took [s]."""

    results: FloatArray
    failures: list[Failure]
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Rows of results in columns, whose parts are files of a directory."""

    folder: Path
    columns: tuple[str, ...]  # of the results
    rows: int  # of the whole sweep
    digest: str  # of all that decides the results

    def paths(self) -> dict[Rows, Path]:
        """Return the files that there are, in the order of their rows."""
        paths = {}
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            for path in sorted(self.folder.iterdir()):
                if place := _PART.fullmatch(path.name):
                    paths[int(place[1]), int(place[2])] = path
        for (before, path), (after, other) in pairwise(paths.items()):
            if after[0] < before[1]:
                refuse(other, f"has rows that are in {path.name}, too. {_DELETE}")
        return paths

    def missing(self) -> list[Rows]:
        """Return the ranges of rows that no part has."""
        there = list(self.paths())
        starts, stops = [*(start for start, _ in there), self.rows], [0, *(s for _, s in there)]
        return [(a, b) for a, b in zip(stops, starts, strict=True) if a < b]

    def write(self, rows: Rows, result: Result, seconds: float) -> None:
        """Write the result of some rows, which has all of them and all columns."""
        columns, failures = result
        content = np.column_stack([columns[name] for name in self.columns])
        if len(content) != rows[1] - rows[0]:
            raise ValueError(f"{len(content)} rows")
        meta: dict[str, Any] = {"sweep": self.digest, "failures": failures, "seconds": seconds}
        meta["digest"] = array_file.digest({"RESULTS": content}, meta)
        name = "{:010d}-{:010d}.npz".format(*rows)
        packed = array_file.npz_bytes({"RESULTS": content}, json.dumps(meta))
        write_atomically(self.folder / name, packed)

    def read(self, path: Path) -> Part:
        """Return what a file holds; refuse it where it is damaged, or is of another sweep."""
        try:
            arrays, text = array_file.read_npz(read_bytes(path, OutputError))
            meta = json.loads(text)
            intact = meta["digest"] == array_file.digest(arrays, meta)
            results, sweep = arrays["RESULTS"], meta["sweep"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            refuse(path, f"is damaged. {_DELETE}", error)
        start, stop = map(int, path.stem.split("-"))
        if intact and sweep != self.digest:
            refuse(
                path,
                "is of another study: other settings, inputs, or another version of lbt_synth. "
                "Name another directory, or delete it.",
            )
        if not intact or results.shape != (stop - start, len(self.columns)):
            refuse(path, f"is damaged. {_DELETE}")
        return Part(results, [tuple(failure) for failure in meta["failures"]], meta["seconds"])

    def run(
        self,
        function: Callable[..., Result],
        arguments: Callable[[Rows], tuple[Any, ...]],
        *,
        part_rows: int,
        executor: futures.Executor | None = None,
        workers: int | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> tuple[Part, int]:
        """Evaluate what is missing; return all rows, and how many of them were computed now.

        Without an executor the parts run here. Each is written as it comes.
        """
        folder, count = make_directory(self.folder, parents=False), progress or (lambda rows: None)
        in_flight = 1
        if executor is not None:  # two a worker, so that none waits
            pool_size = getattr(executor, "_max_workers", None) or os.cpu_count() or 1
            in_flight = 2 * (workers or pool_size)
        # more parts than are in flight, so that no worker waits long for the last
        share = -(-self.rows // (2 * in_flight + 2))
        with exclusive_lock(folder, "computation"):
            for path in folder.glob(UNFINISHED):
                path.unlink()  # what a killed process left
            for path in self.paths().values():
                self.read(path)  # refuses what is damaged before any work
            missing, size = self.missing(), min(part_rows, share)
            computed = sum(stop - start for start, stop in missing)
            if computed < self.rows:
                count(self.rows - computed)
            waiting = (
                (first, min(first + size, stop))
                for start, stop in missing
                for first in range(start, stop, size)
            )
            tasks = ((rows, arguments(rows)) for rows in waiting)
            for rows, result, seconds in _compute(function, tasks, executor, in_flight):
                with _explain_failure(rows):
                    self.write(rows, result, seconds)
                count(rows[1] - rows[0])
            parts = [self.read(path) for path in self.paths().values()]
        failures = [failure for part in parts for failure in part.failures]
        results = np.concatenate([part.results for part in parts])
        return Part(results, failures, sum(part.seconds for part in parts)), computed


def _compute(
    function: Callable[..., Result],
    tasks: Iterator[tuple[Rows, tuple[Any, ...]]],
    executor: futures.Executor | None,
    in_flight: int,
) -> Iterator[tuple[Rows, Result, float]]:
    """Yield results as they come; if one task fails as a whole, the others are given up."""
    for rows, arguments in tasks if executor is None else ():
        with _explain_failure(rows):
            result, seconds = _timed(function, *arguments)
        yield rows, result, seconds
    running: dict[futures.Future[tuple[Result, float]], Rows] = {}
    try:
        while executor is not None:
            for rows, arguments in islice(tasks, in_flight - len(running)):
                with _explain_failure(rows):
                    running[executor.submit(_timed, function, *arguments)] = rows
            if not running:
                return
            for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                rows = running.pop(future)
                with _explain_failure(rows):
                    result, seconds = future.result()
                yield rows, result, seconds
    finally:
        for future in running:
            future.cancel()


def refuse(path: Path, why: str, cause: Exception | None = None) -> NoReturn:
    """Refuse a file or a directory."""
    raise OutputError(f"{path} {why}", path=path) from cause


def _timed(function: Callable[..., Result], *arguments: Any) -> tuple[Result, float]:
    before = time.perf_counter()
    result = function(*arguments)
    return result, time.perf_counter() - before


@contextlib.contextmanager
def _explain_failure(rows: Rows) -> Iterator[None]:
    """Say what to do where a part as a whole fails, or its worker dies."""
    try:
        yield
    except (LbtSynthError, MemoryError):
        raise
    except Exception as error:
        text = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": .")
        raise NumericalError(
            f"rows {rows[0]} to {rows[1] - 1} have no result ({text}): a process died, perhaps out "
            "of memory, or has another lbt_synth than this one. What is written is kept: start "
            "the study again, perhaps with fewer jobs, and it goes on from there."
        ) from error
