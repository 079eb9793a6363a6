"""Files: read as a whole, written as a whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from lbt_synth.errors import OutputError


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
    if target.is_dir():
        raise OutputError(f"{target} is a directory; expected the name of a file.", path=target)
    temporary = None
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
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()
        raise OutputError(
            f"cannot write {target}: {error.strerror or error}. Choose a directory that exists "
            "and can be written.",
            path=target,
        ) from error
    return target
