"""Where work runs: in this process, in others of this machine, or on a Dask cluster.

Linear algebra has one thread, here and in workers: with more, small matrices are slower. Nothing
here imports numpy, whose threads are limited before it is loaded; nothing else imports Dask.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

import lbt_synth
from lbt_synth.errors import MissingExtraError, ProblemError

_TIMEOUT_S = 10  # for a scheduler of Dask and its first worker to answer
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def limit_threads() -> Iterator[None]:
    """Limit linear algebra that is loaded in the block, and processes started in it, to a thread.

    What the environment says already stays.
    """
    free = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(free, "1"))
    try:
        yield
    finally:
        for name in free:
            del os.environ[name]


class WorkerPool(ProcessPoolExecutor):
    """Fresh processes that end with their parent, however it ends.

    Start it within :func:`limit_threads`, whose limit the processes inherit. An error in its
    ``with`` block ends them at once, without waiting for what is running.
    """

    def __init__(self, workers: int) -> None:
        self._others: set[BaseProcess] = set(multiprocessing.active_children())
        super().__init__(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_end_with_parent,
        )

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            for worker in set(multiprocessing.active_children()) - self._others:
                worker.terminate()
        self.shutdown(wait=True, cancel_futures=True)


def _end_with_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it, and ends the workers

    def watch() -> None:
        if parent := multiprocessing.parent_process():
            parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def choose_engine(
    jobs: int, dask: str | None = None
) -> Iterator[tuple[Executor | None, int | None]]:
    """Provide the executor of a Dask scheduler or of processes with its workers; None for one.

    The processes have one thread each, and end at once if the block fails.
    """
    if dask is not None:
        with connect_cluster(dask) as cluster:
            yield cluster
    elif jobs == 1:
        yield None, None
    else:
        with limit_threads(), WorkerPool(jobs) as pool:
            yield pool, jobs


@contextmanager
def connect_cluster(address: str) -> Iterator[tuple[Executor, int]]:
    """Provide the executor of a Dask scheduler with this package, and how many threads it has.

    A scheduler can run code on its clients: name only one that you trust. Dask's own configuration
    names the files of an encrypted connection.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError(
            '--dask needs dask.distributed; try: pip install "lbt-synth[dask]".', extra="dask"
        ) from error
    try:
        client: Any = Client(address, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        text = " ".join(str(error).split()) or "no answer"
        raise ProblemError(
            f"no Dask scheduler answers at {address!r} ({text.rstrip('.')}). Expected an address "
            "such as tcp://host:8786; start one with dask scheduler, and dask worker."
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_TIMEOUT_S)
        except TimeoutError as error:
            raise ProblemError(
                f"the scheduler at {address} has no workers; start some with dask worker {address}."
            ) from error
        hosts = client.get_versions(packages=["lbt_synth"])["workers"]
        versions = {host["packages"].get("lbt_synth") or "none" for host in hosts.values()}
        if versions != {lbt_synth.__version__}:
            raise ProblemError(
                f"all workers must have lbt_synth {lbt_synth.__version__}, as here; those of "
                f"{address} have {', '.join(sorted(versions))}. Start them from the same "
                "environment."
            )
        yield client.get_executor(pure=False), sum(client.ncores().values())
