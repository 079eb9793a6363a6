"""Run many independent cases, one file each, and resume where a killed run stopped.

A case is a name and arguments that JSON can hold. Its result is written as soon as it is
known, whole or not at all, with a digest of the case. Only the process that started the run
writes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from lbt_synth.errors import NumericalError, OutputError, ProblemError
from lbt_synth.storage.atomic_files import exclusive_lock, write_atomically
from lbt_synth.storage.input_files import read_json
from lbt_synth.storage.thread_limits import limit_threads
from lbt_synth.storage.worker_processes import WorkerPool
from lbt_synth.validation import integer

Case = Mapping[str, Any]
Key = TypeVar("Key")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,199}\Z")


def run_cases(
    function: Callable[[Case], Mapping[str, Any]],
    cases: Mapping[str, Case],
    directory: str | os.PathLike[str],
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Run the cases that have no result yet, and return the results of all.

    Parameters
    ----------
    function : callable
        Maps a case to its result, a mapping that JSON can hold; importable by name if
        other processes run it. Its result must depend on the case only.
    cases : mapping of str to mapping
        Arguments of each case, by its name, which is also that of its file.
    directory : path-like
        An existing directory; results go into ``NAME.json``.
    jobs : int, optional
        Processes; 1 runs in this one.
    executor : concurrent.futures.Executor, optional
        Runs the cases instead of ``jobs`` processes, and is left open.
    progress : callable, optional
        Called with the number of cases that were found or finished since its last call.

    Returns
    -------
    dict of str to dict
        Results in the order of the cases.

    Raises
    ------
    OutputError
        If the directory holds results of other arguments under these names, is in use by
        another run, or cannot be written.
    ProblemError
        If a name is not a valid file name, or a case or a result does not fit into JSON.
    NumericalError
        If a process ended without a result.

    Examples
    --------
    >>> import tempfile
    >>> from lbt_synth.storage import run_cases
    >>> def double(case):
    ...     return {"twice": 2 * case["x"]}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = run_cases(double, {"a": {"x": 1}}, folder)
    ...     both = run_cases(double, {"a": {"x": 1}, "b": {"x": 2}}, folder)  # only b is run
    >>> both
    {'a': {'twice': 2}, 'b': {'twice': 4}}
    """
    folder = Path(directory)
    jobs = integer(jobs, "jobs", at_least=1)
    digests = {name: _case_digest(name, case) for name, case in cases.items()}
    with exclusive_lock(folder, "computation"):
        found = {name: _read(folder / f"{name}.json", digests[name]) for name in cases}
        results = {name: result for name, result in found.items() if result is not None}
        if progress is not None and results:
            progress(len(results))
        missing = [(name, (dict(case),)) for name, case in cases.items() if name not in results]
        failed = []
        with (
            _executor(executor, min(jobs, len(missing))) as pool,
            contextlib.closing(
                finished_calls(pool, function, missing, in_flight=calls_in_flight(pool))
            ) as finished,
        ):
            for name, future in finished:
                if future.cancelled() or future.exception() is not None:
                    failed.append(future)
                    continue
                results[name] = _write(folder, name, digests[name], cases[name], future.result())
                if progress is not None:
                    progress(1)
            if failed:
                failed[0].result()
    return {name: results[name] for name in cases}


class InlineExecutor(Executor):
    """Executor that runs each call at once in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a call; its error is that of the future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def finished_calls(
    executor: Executor,
    function: Callable[..., Any],
    calls: Iterable[tuple[Key, tuple[Any, ...]]],
    *,
    in_flight: int,
) -> Generator[tuple[Key, Future[Any]], None, None]:
    """Yield the keys and futures of calls as they finish, of which some are in flight at a time.

    If one fails, no other begins, and those that run are waited for.
    """
    waiting, running = iter(calls), dict[Future[Any], Key]()
    failed = False
    try:
        while True:
            for key, arguments in islice(waiting, 0 if failed else in_flight - len(running)):
                running[_submit(executor, function, arguments)] = key
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                failed = failed or future.cancelled() or future.exception() is not None
                yield running.pop(future), future
    finally:
        for future in running:
            future.cancel()


def _submit(
    executor: Executor, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> Future[Any]:
    """Submit a call; the future has the error of an executor that is broken."""
    try:
        return executor.submit(function, *arguments)
    except Exception as error:
        future: Future[Any] = Future()
        future.set_exception(error)
        return future


def calls_in_flight(executor: Executor, workers: int | None = None) -> int:
    """Return how many calls an executor has at a time: two a worker, so that none waits."""
    if isinstance(executor, InlineExecutor):
        return 1
    return 2 * (workers or getattr(executor, "_max_workers", None) or os.cpu_count() or 1)


@contextlib.contextmanager
def _executor(executor: Executor | None, workers: int) -> Iterator[Executor]:
    """Provide an executor: that of the caller, this process, or others.

    An error in the block ends other processes at once.
    """
    if executor is not None or workers <= 1:
        yield executor or InlineExecutor()
        return
    try:
        with limit_threads(), WorkerPool(workers) as pool:
            yield pool
    except BrokenExecutor as error:
        raise NumericalError(
            "a worker process died, perhaps out of memory. "
            "Finished results are kept. Start again with fewer jobs."
        ) from error


def _case_digest(name: str, case: Case) -> str:
    if not isinstance(name, str) or not _NAME.match(name):
        raise ProblemError(
            f"the name of a case must be at most 200 letters, digits and . _ + -; got {name!r}."
        )
    try:
        return _digest(case)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"the case {name} must fit into JSON: {error}.") from error


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(dict(content), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _read(path: Path, expected: str) -> dict[str, Any] | None:
    """Return the result in a file, or None without a file; refuse a file of another case."""
    if not path.exists():
        return None
    try:
        content = read_json(path, OutputError)
        asked, digest, result = content["asked"], content["digest"], dict(content["result"])
    except (ValueError, KeyError, TypeError) as error:
        why = f"is not the result of a run: {error}. Delete it, or name another directory."
        raise OutputError(f"{path} {why}", path=path) from error
    if asked == expected and digest == _digest(result):
        return result
    why = "was changed after it was written. Delete it to run its case again."
    if asked != expected:
        why = (
            "is the result of other settings. Name another directory, or delete the results of the "
            "old settings."
        )
    raise OutputError(f"{path} {why}", path=path)


def _write(
    folder: Path, name: str, asked: str, case: Case, result: Mapping[str, Any]
) -> dict[str, Any]:
    try:
        written = {"asked": asked, "digest": _digest(result), "case": case, "result": dict(result)}
        text = json.dumps(written, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ProblemError(f"the result of {name} must fit into JSON: {error}.") from error
    write_atomically(folder / f"{name}.json", text.encode())
    return dict(json.loads(text)["result"])
