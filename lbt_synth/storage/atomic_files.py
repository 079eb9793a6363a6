"""Write files whole or not at all, never over an input, a link, a device or a pipe."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from lbt_synth.errors import FileError, OutputError
from lbt_synth.storage.input_files import error_text
from lbt_synth.validation import file_path

try:
    import fcntl
except ImportError:  # on Windows a second process goes unnoticed
    fcntl = None  # type: ignore[assignment]

UNFINISHED = ".lbt_synth.*.tmp"  # beside what is being written


def require_ending(
    path: str | os.PathLike[str],
    what: str,
    endings: Iterable[str],
    error: type[FileError] = OutputError,
) -> Path:
    """Return the path of a file; refuse it where it has none of the endings."""
    target = file_path(path, what)
    if target.suffix.lower() not in endings:
        raise error(f"{what} must end in {', '.join(endings)}; got {target.name!r}.", path=target)
    return target


def make_directory(path: str | os.PathLike[str], *, parents: bool = True) -> Path:
    """Make a directory, and its parents, if there is none, and return its path."""
    folder = Path(path)
    try:
        folder.mkdir(parents=parents, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the directory {folder}: {error.strerror}.", path=folder
        ) from error
    return folder


def require_writable(
    *paths: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]] = ()
) -> None:
    """Refuse outputs that cannot be written or would replace an input, before any work is done."""
    refuse_replacing(paths, inputs)
    for path in paths:
        target = Path(path)
        if not os.path.isdir(target.parent):  # noqa: PTH112 - False for a name that is too long
            raise OutputError(f"cannot write {target}: no directory {target.parent}.", path=target)
        try:
            _require_file(target)
            with tempfile.TemporaryFile(dir=target.parent):
                pass
        except (OSError, ValueError) as error:
            raise OutputError(
                f"cannot write {target}: the directory {target.parent} takes no new files "
                f"({error_text(error)}).",
                path=target,
            ) from error


def refuse_replacing(
    outputs: Iterable[str | os.PathLike[str]], inputs: Iterable[str | os.PathLike[str]]
) -> None:
    """Refuse to write to an input, under whatever name, symbolic or hard link."""
    read = list(inputs)
    for path in outputs:
        for source in read:
            if _is_same(Path(path), Path(source)):
                raise OutputError(
                    f"{path} must not replace the input {source}; give another name.",
                    path=Path(path),
                )


def _require_file(target: Path) -> None:
    """Refuse to replace what is no regular file."""
    try:
        mode = target.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFDIR: "a directory", stat.S_IFLNK: "a link"}
        kind = kinds.get(stat.S_IFMT(mode), "a device or a pipe")
        raise OutputError(f"{target} is {kind}; expected the name of a file.", path=target)


def _is_same(one: Path, other: Path) -> bool:
    try:
        return one.resolve() == other.resolve() or one.samefile(other)
    except (OSError, ValueError, RuntimeError):  # missing, no valid name, or a ring of links
        return False


def write_atomically(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file through a temporary one in the same directory."""
    return write_together({path: content})[0]


def write_together(contents: Mapping[str | os.PathLike[str], bytes]) -> tuple[Path, ...]:
    """Write files that belong together: each is on the disk before the first gets its name."""
    with contextlib.ExitStack() as streams:
        opened = [streams.enter_context(open_atomically(path)) for path in contents]
        for stream, content in zip(opened, contents.values(), strict=True):
            stream.write(content)
            _synchronise(stream)
    return tuple(map(Path, contents))


@contextlib.contextmanager
def open_atomically(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a stream whose content becomes a file only when the block ends without an error."""
    target = Path(path)
    temporary = target.with_name(UNFINISHED.replace("*", secrets.token_hex(8)))
    try:
        _require_file(target)
        stream = temporary.open("xb")
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise _output_error(target, error) from error
    try:
        with stream:
            yield stream
            _synchronise(stream)
        if target.exists():
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        temporary.replace(target)
    except OSError as error:
        raise _output_error(target, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def _output_error(target: Path, error: Exception) -> OutputError:
    return OutputError(
        f"cannot write {target}: {error_text(error)}. Check the directory and its free space.",
        path=target,
    )


def _synchronise(stream: BinaryIO) -> None:
    """Bring what was written to the disk."""
    stream.flush()
    os.fsync(stream.fileno())


@contextlib.contextmanager
def exclusive_lock(folder: Path, what: str) -> Iterator[None]:
    """Hold a lock on a directory, which the system releases when the process ends in any way."""
    path = folder / ".lock"
    try:
        stream = path.open("ab")
    except OSError as error:
        why = f"cannot write into {folder}: {path.name}: {error_text(error)}."
        raise OutputError(why, path=path) from error
    with stream:
        try:
            if fcntl is not None:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(
                f"another {what} is running in {folder}. Wait for it, or name another directory.",
                path=folder,
            ) from error
        try:
            yield
        finally:
            if fcntl is not None:  # at once: a process that is being started holds a copy
                fcntl.flock(stream, fcntl.LOCK_UN)
