"""Run many independent cases, one file each, and resume where a killed run stopped.

A case is a name and arguments: what JSON can hold, arrays and dataclasses. Its result is written as
soon as it is known, whole or not at all, with a digest of the case. Only the process that started
the run writes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, as_completed
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from lbt_synth.errors import NumericalError, OutputError, ProblemError
from lbt_synth.storage.atomic_files import exclusive_lock, write_atomically
from lbt_synth.storage.input_files import read_json
from lbt_synth.storage.thread_limits import limit_threads
from lbt_synth.storage.worker_processes import WorkerPool
from lbt_synth.validation import integer

Case = Mapping[str, Any]
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
        other processes run it, as what is in the case must be. Its result must depend on the
        case only.
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
        missing = {name: case for name, case in cases.items() if name not in results}
        with contextlib.closing(_results(function, missing, jobs, executor)) as finished:
            for name, result in finished:
                results[name] = _write(folder, name, digests[name], cases[name], result)
                if progress is not None:
                    progress(1)
    return {name: results[name] for name in cases}


def _results(
    function: Callable[[Case], Mapping[str, Any]],
    cases: Mapping[str, Case],
    jobs: int,
    executor: Executor | None,
) -> Generator[tuple[str, Mapping[str, Any]], None, None]:
    """Yield results as they come; if a case fails, wait for those that are running."""
    if executor is None and (jobs == 1 or len(cases) <= 1):
        for name, case in cases.items():
            yield name, function(case)
        return
    workers = min(jobs, len(cases))
    with _processes(workers) if executor is None else contextlib.nullcontext(executor) as pool:
        futures = {pool.submit(function, dict(case)): name for name, case in cases.items()}
        try:
            for future in as_completed(futures):
                if not future.cancelled() and future.exception() is None:
                    yield futures[future], future.result()
                else:
                    _cancel(futures)
        finally:
            _cancel(futures)
        for future in futures:  # raise the error of the first case that failed
            if not future.cancelled():
                future.result()


def _cancel(futures: Iterable[Future[Any]]) -> None:
    for future in futures:
        future.cancel()


@contextlib.contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    """Provide processes; an error in the block ends them at once."""
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
    except (TypeError, ValueError, AttributeError) as error:
        raise ProblemError(f"the case {name} must fit into JSON: {error}.") from error


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(dict(content), sort_keys=True, allow_nan=False, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return an array or a dataclass as what JSON can hold."""
    if is_dataclass(value):
        return {each.name: getattr(value, each.name) for each in fields(value)}
    return value.tolist()


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
        text = json.dumps(written, indent=1, allow_nan=False, default=_plain)
    except (TypeError, ValueError, AttributeError) as error:
        raise ProblemError(f"the result of {name} must fit into JSON: {error}.") from error
    write_atomically(folder / f"{name}.json", text.encode())
    return dict(json.loads(text)["result"])
