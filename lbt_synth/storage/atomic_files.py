"""Write files whole or not at all, never over an input, a link, a device or a pipe."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from lbt_synth.errors import FileError, OutputError
from lbt_synth.storage.file_locks import CAN_LOCK, lock_file
from lbt_synth.storage.input_files import error_text, open_regular

_UNFINISHED = ".lbt_synth.{}.{}.tmp"  # beside a target: digest of its name, and a number
_MOST_UNFINISHED = 100  # of one target, by as many processes at once


def require_ending(
    path: str | os.PathLike[str],
    what: str,
    endings: Iterable[str],
    error: type[FileError] = OutputError,
) -> Path:
    """Return the path of a file; refuse it where it has none of the endings."""
    target = Path(path)
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
    """Refuse outputs that cannot be written or would replace an input, before any work is done.

    Examples
    --------
    >>> from lbt_synth.storage.atomic_files import require_writable
    >>> require_writable("nowhere/at/all.png")
    Traceback (most recent call last):
        ...
    lbt_synth.errors.OutputError: cannot write nowhere/at/all.png: no directory nowhere/at.
    """
    refuse_replacing(paths, inputs)
    for path in paths:
        target = Path(path)
        if not os.path.isdir(target.parent):  # noqa: PTH112 - False for a name that is too long
            raise OutputError(f"cannot write {target}: no directory {target.parent}.", path=target)
        _mode_of(target)
        try:
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
    """Refuse to write to an input, under whatever name, symbolic or hard link.

    Examples
    --------
    >>> from lbt_synth.storage.atomic_files import refuse_replacing
    >>> refuse_replacing(["a/../k.fits"], ["k.fits"])
    Traceback (most recent call last):
        ...
    lbt_synth.errors.OutputError: a/../k.fits must not replace the input k.fits; give another name.
    """
    read = list(inputs)
    for path in outputs:
        for source in read:
            if _is_same(Path(path), Path(source)):
                raise OutputError(
                    f"{path} must not replace the input {source}; give another name.",
                    path=Path(path),
                )


def _mode_of(target: Path) -> int | None:
    """Return the permissions of a file that would be replaced, None if there is none."""
    try:
        found = target.lstat()
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise _output_error(target, error) from error
    if stat.S_ISREG(found.st_mode):
        return stat.S_IMODE(found.st_mode)
    kind = "a device or a pipe"
    if stat.S_ISDIR(found.st_mode):
        kind = "a directory"
    elif stat.S_ISLNK(found.st_mode):
        kind = f"a link to {target.readlink()}"
    raise OutputError(f"{target} is {kind}; expected the name of a file.", path=target)


def _is_same(one: Path, other: Path) -> bool:
    try:
        return one.resolve() == other.resolve() or one.samefile(other)
    except (OSError, ValueError, RuntimeError):  # missing, no valid name, or a ring of links
        return False


def write_atomically(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file through a temporary one in the same directory.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from lbt_synth.storage.atomic_files import write_atomically
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(pathlib.Path(folder) / "a.txt", b"whole").read_bytes()
    b'whole'
    """
    return write_together({path: content})[0]


def write_together(contents: Mapping[str | os.PathLike[str], bytes]) -> tuple[Path, ...]:
    """Write files that belong together: all of them, or none.

    Every file is written in full under a temporary name before the first is renamed.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from lbt_synth.storage.atomic_files import write_together
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     at = pathlib.Path(folder)
    ...     [p.name for p in write_together({at / "a.c": b"code", at / "a.h": b"names"})]
    ['a.c', 'a.h']
    """
    targets = {Path(path): content for path, content in contents.items()}
    staged: dict[Path, Path] = {}
    target = next(iter(targets))
    with contextlib.ExitStack() as temporaries, contextlib.ExitStack() as undo:
        try:
            for target, content in targets.items():
                stream, staged[target] = temporaries.enter_context(_temporary_file(target))
                stream.write(content)
                _finish(stream)
            for target, temporary in staged.items():
                # kept to undo the change if a later file fails; a single file needs no undoing
                older = target.read_bytes() if len(targets) > 1 and target.exists() else None
                temporary.replace(target)
                undo.callback(_restore, target, older)
        except (OSError, ValueError) as error:  # ValueError: a null character in the name
            raise _output_error(target, error) from error
        undo.pop_all()
    return tuple(targets)


def _restore(target: Path, older: bytes | None) -> None:
    """Give a file its older content again, or delete it."""
    with contextlib.suppress(OSError, OutputError):
        if older is None:
            target.unlink()
        else:
            write_atomically(target, older)


@contextlib.contextmanager
def _temporary_file(target: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """Open a temporary file beside a target; after the block there is none under its name.

    It is locked to the end of the block, so that another process knows it for unfinished.
    """
    mode = _mode_of(target)
    handle, temporary = _create_temporary(target)
    lock = os.dup(handle) if CAN_LOCK else None
    try:
        with os.fdopen(handle, "wb") as stream:
            if mode is not None:
                temporary.chmod(mode)
            yield stream, temporary
    finally:
        if lock is None or _is_open(lock, temporary):
            _restore(temporary, None)
        if lock is not None:
            os.close(lock)


def _finish(stream: BinaryIO) -> None:
    """Bring a whole file to the disk."""
    stream.flush()
    os.fsync(stream.fileno())
    stream.close()


def _create_temporary(target: Path) -> tuple[int, Path]:
    """Create a temporary file and lock it; one that a killed run left is removed."""
    digest = hashlib.sha256(os.fsencode(target.name)).hexdigest()[:16]
    for number in range(_MOST_UNFINISHED):
        path = target.with_name(_UNFINISHED.format(digest, number))
        _remove_unlocked(path)
        with contextlib.suppress(FileExistsError):
            handle = open_regular(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
            lock_file(handle)
            if _is_open(handle, path):  # else it was removed before the lock
                return handle, path
            os.close(handle)
    raise OSError(errno.EEXIST, f"{_MOST_UNFINISHED} files {path.name} are in the way")


def remove_unfinished_files(folder: Path) -> None:
    """Remove the temporary files in a directory that no process is writing."""
    for path in folder.glob(_UNFINISHED.format("*", "*")):
        _remove_unlocked(path)


def _remove_unlocked(path: Path) -> None:
    """Remove a temporary file whose process is dead."""
    with contextlib.suppress(OSError):
        if stat.S_ISREG(path.lstat().st_mode):
            handle = open_regular(path, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if lock_file(handle) and _is_open(handle, path):
                    path.unlink()
            finally:
                os.close(handle)


def _is_open(handle: int, path: Path) -> bool:
    """Whether a file is still under the name by which it was opened."""
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def open_atomically(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a stream whose content becomes a file only when the block ends without an error.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> from lbt_synth.storage.atomic_files import open_atomically
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with open_atomically(pathlib.Path(folder) / "a.txt") as stream:
    ...         _ = stream.write(b"part by part")
    ...     (pathlib.Path(folder) / "a.txt").read_bytes()
    b'part by part'
    """
    target = Path(path)
    try:
        with _temporary_file(target) as (stream, temporary):
            yield stream
            _finish(stream)
            temporary.replace(target)
    except OSError as error:
        raise _output_error(target, error) from error


def _output_error(target: Path, error: Exception) -> OutputError:
    return OutputError(
        f"cannot write {target}: {error_text(error)}. Check the directory and its free space.",
        path=target,
    )
