"""Locks on files, which the system releases when their process ends in any way."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from lbt_synth.errors import OutputError
from lbt_synth.storage.input_files import error_text, open_regular

try:
    import fcntl
except ImportError:  # on Windows a second process goes unnoticed
    CAN_LOCK = False
else:
    CAN_LOCK = True


def lock_file(handle: int) -> bool:
    """Lock an open file; return False where another process has, or the system has no locks."""
    if not CAN_LOCK:
        return False
    with contextlib.suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


def unlock_file(handle: int) -> None:
    """Release a lock at once: a process that is being started holds a copy of each open file."""
    if CAN_LOCK:
        fcntl.flock(handle, fcntl.LOCK_UN)


@contextlib.contextmanager
def exclusive_lock(folder: Path, what: str) -> Iterator[None]:
    """Hold a lock on a directory."""
    path = folder / ".lock"
    try:
        handle = open_regular(path, os.O_RDWR | os.O_CREAT)
    except OSError as error:
        why = f"cannot write into {folder}: {path.name}: {error_text(error)}."
        raise OutputError(why, path=path) from error
    try:
        if CAN_LOCK and not lock_file(handle):
            raise OutputError(
                f"another {what} is running in {folder}. Wait for it, or name another directory.",
                path=folder,
            )
        yield
    finally:
        unlock_file(handle)
        os.close(handle)
