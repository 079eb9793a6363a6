"""One thread of linear algebra, here and in workers: with more, small matrices are slower."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess

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

    Start it within :func:`limit_threads`, whose limit the
    processes inherit. An error in its ``with`` block ends them at once, without waiting for what is
    running.
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
