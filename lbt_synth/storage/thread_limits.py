"""One thread of linear algebra: with more, small matrices are slower, on busy cores by far."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

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
