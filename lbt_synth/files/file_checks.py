"""A kind of file, of gains or telemetry: written with a digest, and checked when it is read."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lbt_synth.errors import FileError
from lbt_synth.storage.array_file import (
    Cards,
    digest,
    error_reason,
    fits_bytes,
    npz_bytes,
    read_fits,
    read_npz,
)
from lbt_synth.storage.atomic_files import write_atomically
from lbt_synth.validation import FloatArray

READERS = {".fits": read_fits, ".npz": read_npz}


def _unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; refuse a name that stands twice."""
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a name stands twice in one object of its JSON")
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class FileKind:
    """A kind of file, with the errors that are raised where one cannot be read."""

    name: str
    schema: str  # the mark of the kind in its metadata
    version: int  # of the layout
    error: type[FileError]
    version_error: type[FileError]
    again: str  # how such a file is made: a sentence

    def write(
        self,
        target: Path,
        arrays: Mapping[str, Any],
        meta: dict[str, Any],
        cards: Callable[[dict[str, Any]], Cards],
        headers: Mapping[str, Cards] | None = None,
    ) -> Path:
        """Write arrays and metadata, with their digest, as FITS or NPZ by the ending."""
        meta["digest"] = digest(arrays, meta)
        text = json.dumps(meta, allow_nan=False)
        if target.suffix.lower() == ".fits":
            content = fits_bytes(cards(meta), arrays, text, headers=headers)
        else:
            content = npz_bytes(arrays, text)
        return write_atomically(target, content)

    def decode(self, content: bytes, source: Path) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Return the arrays and the metadata, of a layout that is known and with their digest."""
        try:
            arrays, text = READERS[source.suffix.lower()](content)
            meta = json.loads(text, object_pairs_hook=_unique_names)
            found = digest(arrays, meta) if isinstance(meta, dict) else ""
        except Exception as error:  # foreign bytes: the decoders raise whatever they like
            why = f"{source} is no {self.name}, or it is damaged: {error_reason(error)}."
            raise self.error(f"{why} {self.again}", path=source) from error
        if not isinstance(meta, dict) or meta.get("schema") != self.schema:
            raise self.error(f"{source} is not a {self.name} of lbt_synth.", path=source)
        version = meta.get("schema_version")
        if version != self.version:
            raise self.version_error(
                f"{source} has layout version {version!r}, of lbt_synth "
                f"{meta.get('library_version')}; this version reads {self.version}. {self.again}",
                path=source,
            )
        if meta.get("digest") != found:
            raise self.error(
                f"{source} is damaged: its content does not match its digest. {self.again}",
                path=source,
            )
        return arrays, meta

    @contextmanager
    def rebuilding(self, source: Path) -> Iterator[None]:
        """Build what a file holds in the block; what does not fit is the file's fault."""
        try:
            yield
        except FileError:
            raise
        except Exception as error:  # foreign content fails in whatever way
            raise self.error(
                f"{source} is inconsistent: {error_reason(error)}. {self.again}", path=source
            ) from error
