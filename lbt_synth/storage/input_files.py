"""What is read: regular files up to a size."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

from lbt_synth.errors import FileError

LARGEST_BYTES = 2**30  # of a file that is read whole
LARGEST_TEXT_BYTES = 2**24  # of a file that people write, or of one result


@contextlib.contextmanager
def open_input(path: str | os.PathLike[str], error: type[FileError]) -> Iterator[BufferedReader]:
    """Open a regular file; where it cannot be read, raise an error of a kind."""
    source = Path(path)
    try:
        if source.exists() and not source.is_file() and not source.is_dir():
            raise OSError(errno.EINVAL, "it is not a regular file")  # noqa: TRY301 - as open says
        with source.open("rb") as stream:
            yield stream
    except (OSError, ValueError) as why:  # ValueError: a null character in the name
        shown = path if isinstance(why, OSError) else repr(str(path))
        raise error(f"cannot read {shown}: {error_text(why)}.", path=source) from why


def read_bytes(
    path: str | os.PathLike[str], error: type[FileError], *, most: int = LARGEST_BYTES
) -> bytes:
    """Return the content of a regular file of at most so many bytes."""
    with open_input(path, error) as stream:
        fits = os.fstat(stream.fileno()).st_size <= most
        content = stream.read() if fits else b""
    if not fits:
        limit = f"{most >> 20} MB" if most >> 20 else f"{most >> 10} kB"
        raise error(f"cannot read {path}: it is larger than {limit}.", path=Path(path))
    return content


def file_sha256(path: str | os.PathLike[str], error: type[FileError]) -> str:
    """Return the SHA-256 of a regular file, as ``sha256sum`` prints it."""
    with open_input(path, error) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def error_text(error: Exception) -> object:
    """Return what the system says of an error."""
    return getattr(error, "strerror", None) or error
