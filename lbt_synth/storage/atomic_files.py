"""Read whole files, write them whole or not at all, and never over an input."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from lbt_synth.errors import FileError, OutputError


def read_bytes(path: str | os.PathLike[str], error: type[FileError]) -> bytes:
    """Return the content of a file; where it cannot be read, raise an error of a kind."""
    try:
        return Path(path).read_bytes()
    except (OSError, ValueError) as why:  # ValueError: a null character in the name
        shown = path if isinstance(why, OSError) else repr(str(path))
        raise error(f"cannot read {shown}: {_reason(why)}.", path=Path(path)) from why


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
        if not target.parent.is_dir():
            raise OutputError(f"cannot write {target}: no directory {target.parent}.", path=target)
        _require_no_directory(target)
        try:
            with tempfile.TemporaryFile(dir=target.parent):
                pass
        except (OSError, ValueError) as error:
            raise OutputError(
                f"cannot write {target}: the directory {target.parent} takes no new files "
                f"({_reason(error)}).",
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


def _require_no_directory(target: Path) -> None:
    if target.is_dir():
        raise OutputError(f"{target} is a directory; expected the name of a file.", path=target)


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
    for target in targets:
        _require_no_directory(target)
    staged: dict[Path, Path] = {}
    target = next(iter(targets))
    with contextlib.ExitStack() as undo:
        try:
            for target, content in targets.items():
                staged[target] = _stage(target, content)
                undo.callback(_restore, staged[target], None)
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
    with contextlib.suppress(OSError):
        if older is None:
            target.unlink()
        else:
            _stage(target, older).replace(target)


def _stage(target: Path, content: bytes) -> Path:
    """Write a whole file under a temporary name beside its target; leave none if that fails."""
    with _temporary_file(target) as (stream, temporary):
        stream.write(content)
    return temporary


@contextlib.contextmanager
def _temporary_file(target: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """Open a temporary file beside a target, which is deleted if the block fails."""
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream, temporary
            stream.flush()
            os.fsync(stream.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
    except BaseException:
        _restore(temporary, None)
        raise


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
    _require_no_directory(target)
    try:
        with _temporary_file(target) as (stream, temporary):
            yield stream
        temporary.replace(target)
    except OSError as error:
        raise _output_error(target, error) from error


def _output_error(target: Path, error: Exception) -> OutputError:
    return OutputError(
        f"cannot write {target}: {_reason(error)}. Check the directory and its free space.",
        path=target,
    )


def _reason(error: Exception) -> object:
    return getattr(error, "strerror", None) or error
