"""Files: read as a whole, written as a whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from lbt_synth.errors import OutputError


def require_writable(*paths: str | os.PathLike[str]) -> None:
    """Refuse outputs that cannot be written, before any work is done.

    Parameters
    ----------
    *paths : path-like
        Files to be written.

    Raises
    ------
    OutputError
        If the directory of one does not exist or takes no files, or its name is that of a
        directory.

    Examples
    --------
    >>> from lbt_synth.files import require_writable
    >>> require_writable("nowhere/at/all.png")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.OutputError: cannot write nowhere/at/all.png: no directory nowhere/at.
    """
    for path in paths:
        target = Path(path)
        if not target.parent.is_dir():
            raise OutputError(f"cannot write {target}: no directory {target.parent}.", path=target)
        if target.is_dir():
            raise OutputError(f"{target} is a directory; expected the name of a file.", path=target)
        try:
            with tempfile.TemporaryFile(dir=target.parent):
                pass
        except (OSError, ValueError) as error:
            raise OutputError(
                f"cannot write {target}: the directory {target.parent} takes no new files "
                f"({getattr(error, 'strerror', None) or error}).",
                path=target,
            ) from error


def write_atomically(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file through a temporary one in the same directory.

    Parameters
    ----------
    path : path-like
        Where to write.
    content : bytes
        The whole file.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    OutputError
        If it cannot be written; nothing is left behind, and an older file of
        that name stays as it was.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from lbt_synth.files import write_atomically
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(pathlib.Path(folder) / "a.txt", b"whole").read_bytes()
    b'whole'
    """
    target = Path(path)
    temporary = None
    if target.is_dir():
        raise OutputError(f"{target} is a directory; expected the name of a file.", path=target)
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(target)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        if temporary is not None:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()
        reason = getattr(error, "strerror", None) or error
        raise OutputError(
            f"cannot write {target}: {reason}. Check the directory and its free space.",
            path=target,
        ) from error
    return target
