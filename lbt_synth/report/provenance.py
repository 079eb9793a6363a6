"""When a page was made, by which programs, and from which files."""

from __future__ import annotations

import hashlib
import os
import platform
import unicodedata
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import lbt_synth
from lbt_synth.errors import FileError, ProblemError
from lbt_synth.storage.input_files import read_bytes
from lbt_synth.storage.rows import column, table_row

_DISTRIBUTIONS = ("numpy", "scipy", "matplotlib")
_WRITING_DIRECTIONS = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")


@table_row
class SourceFile:
    """A file that a page was made from."""

    name: str = column("file", help="Its name, without directories")
    role: str = column("what it is", help="What it is")
    sha256: str = column("SHA-256", help="SHA-256 of its bytes, 64 hexadecimal digits")


def read_source(path: str | os.PathLike[str], role: str) -> tuple[SourceFile, bytes]:
    """Read a file, and return its name and digest with its bytes."""
    source = Path(path)
    require_letters(source.name, f"name of the {role}")
    content = read_bytes(source, FileError)
    digest = hashlib.sha256(content).hexdigest()
    return SourceFile(name=source.name, role=role, sha256=digest), content


def require_letters(text: str, what: str) -> str:
    """Refuse a text that no page can show as it is."""
    for letter in text:
        if (
            unicodedata.category(letter) in ("Cc", "Cs")
            or unicodedata.bidirectional(letter) in _WRITING_DIRECTIONS
            or letter in "\ufffe\uffff"
        ):
            raise ProblemError(
                f"{what} must be of letters that a page can show; got {text!a}. Choose another."
            )
    return text


def creation_time() -> datetime:
    """Return the time, in UTC: that of SOURCE_DATE_EPOCH if it is set, else now."""
    given = os.environ.get("SOURCE_DATE_EPOCH")
    if given is None:
        return datetime.now(UTC).replace(microsecond=0)
    try:
        return datetime.fromtimestamp(int(given), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise ProblemError(
            f"SOURCE_DATE_EPOCH must be a number of seconds since 1970; got {given!r}."
        ) from error


def time_text(moment: datetime) -> str:
    """Return a time as a text: 2026-11-21 17:05:09 UTC."""
    return moment.strftime("%Y-%m-%d %H:%M:%S UTC")


def creator_name() -> str:
    """Return the name and version of this program."""
    return f"lbt_synth {lbt_synth.__version__}"


def program_versions(extra: Sequence[str] = ()) -> tuple[tuple[str, str], ...]:
    """Return name and version of the programs that make a page, and of ``extra`` ones."""
    found = [("lbt_synth", lbt_synth.__version__), ("Python", platform.python_version())]
    for name in (*_DISTRIBUTIONS, *extra):
        try:
            found.append((name, version(name)))
        except PackageNotFoundError:
            found.append((name, "not installed"))
    return tuple(found)
