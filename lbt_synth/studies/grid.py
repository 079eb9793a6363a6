"""One grid: samples, a function of one of them or of a stack, an executor, and parts on disk.

What a loop leaves has the same columns for one loop and for a stack of them. A part holds the
results of a fixed number of consecutive rows in a file that is named by them: a sweep that was
killed at any moment goes on with the rows that no part has.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import LbtSynthError, NumericalError, OutputError, ProblemError
from lbt_synth.loop import ClosedLoop, Imaging, ResidualBudget, residual_budget, strehl
from lbt_synth.models import LoopHardware, SinusoidalVibration, Truth, Vibration
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.storage import array_file
from lbt_synth.storage.atomic_files import make_directory, write_atomically
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.validation import FloatArray

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


def moved_lines(
    truth: Truth, errors_hz: ArrayLike, hardware: LoopHardware, name: str = "errors_hz"
) -> list[tuple[Vibration | SinusoidalVibration, FloatArray]]:
    """Return the true vibrations, each with its frequencies [Hz] under e errors, (e,)."""
    errors, nyquist = np.asarray(errors_hz), hardware.frame_rate_hz / 2
    shares, moved = truth.frequency_shifts_hz(1.0), []
    for line, moves in zip(stationary_vibrations(truth.vibrations), shares, strict=True):
        checked_direction(line, hardware)
        frequencies = line.frequency_hz + moves * errors
        wrong = ~((frequencies > 0) & (frequencies < nyquist))
        if np.any(wrong):
            raise ProblemError(
                f"{name} must leave each vibration between 0 and {nyquist:.6g} Hz; got an error "
                f"of {errors[wrong][0]:.6g} Hz, which moves the one at {line.frequency_hz:.6g} Hz "
                f"to {frequencies[wrong][0]:.6g} Hz."
            )
        moved.append((line, frequencies))
    return moved


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


def calls_in_flight(executor: futures.Executor, workers: int | None = None) -> int:
    """Return how many calls an executor has at a time: two a worker, so that none waits."""
    if isinstance(executor, InlineExecutor):
        return 1
    return 2 * (workers or getattr(executor, "_max_workers", None) or os.cpu_count() or 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """The parts of a sweep in a directory."""

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

    def read(self, path: Path) -> tuple[FloatArray, list[Failure], float]:
        """Return the results of a file (b, columns), its failures and its seconds."""
        try:
            arrays, text = array_file.read_npz(read_bytes(path, OutputError))
            meta = json.loads(text)
            whole = meta["digest"] == array_file.digest(arrays, meta)
            results, sweep = arrays["RESULTS"], meta["sweep"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            refuse(path, f"is damaged. {_DELETE}", error)
        start, stop = map(int, path.stem.split("-"))
        if not whole or results.shape != (stop - start, len(self.columns)):
            refuse(path, f"is damaged. {_DELETE}")
        if sweep != self.digest:
            refuse(path, "is of another study. Name another directory, or delete it.")
        return results, [tuple(failure) for failure in meta["failures"]], meta["seconds"]

    def compute_missing(
        self,
        function: Callable[..., Result],
        arguments: Callable[[Rows], tuple[Any, ...]],
        *,
        part_rows: int,
        executor: futures.Executor,
        in_flight: int = 1,
        progress: Callable[[int], None] = lambda rows: None,
    ) -> None:
        """Evaluate what is missing on an executor, a few parts in flight.

        Each part is written as it comes; if one fails as a whole, or its worker dies, the others
        are given up, and a sentence says how to go on.
        """
        if make_directory(self.folder).is_symlink():
            refuse(self.folder, "is a link; expected a directory.")
        waiting = iter(
            (first, min(first + part_rows, stop))
            for start, stop in self.missing()
            for first in range(start, stop, part_rows)
        )
        running: dict[futures.Future[tuple[Result, float]], Rows] = {}
        try:
            while True:
                for rows in islice(waiting, in_flight - len(running)):
                    with _explain_failure(rows):
                        running[executor.submit(timed, function, *arguments(rows))] = rows
                if not running:
                    return
                for future in futures.wait(running, return_when=futures.FIRST_COMPLETED).done:
                    rows = running.pop(future)
                    with _explain_failure(rows):
                        self.write(rows, *future.result())
                    progress(rows[1] - rows[0])
        finally:
            for future in running:
                future.cancel()


def refuse(path: Path, why: str, cause: Exception | None = None) -> NoReturn:
    """Refuse a file or a directory."""
    raise OutputError(f"{path} {why}", path=path) from cause


def timed(function: Callable[..., Result], *arguments: Any) -> tuple[Result, float]:
    """Call a function, and return its result and its seconds."""
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
            "of memory, or has another lbt_synth than this one. What is finished is kept: start "
            "the study again, perhaps with fewer jobs, and it goes on from there."
        ) from error
