"""Warnings that are expected, without a change of the filters under another thread."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_ONE_AT_A_TIME = threading.RLock()  # the filters are those of the whole process


@contextmanager
def ignore_warnings(*kinds: type[Warning], message: str = "") -> Iterator[None]:
    """Ignore warnings in the block: of some kinds or of all, whose message begins so."""
    with _ONE_AT_A_TIME, warnings.catch_warnings():
        for kind in kinds or (Warning,):
            warnings.filterwarnings("ignore", message=message, category=kind)
        yield
