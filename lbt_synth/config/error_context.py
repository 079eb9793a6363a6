"""Context managers that name the key, or the file, that an error is about."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lbt_synth.errors import ConfigError, ProblemError


@contextmanager
def name_key(key: str) -> Iterator[None]:
    """Turn a ProblemError into a ConfigError on a key; one that names its key passes."""
    try:
        yield
    except ConfigError:
        raise
    except ProblemError as error:
        raise ConfigError(f"{key}: {error}", path=key) from error


@contextmanager
def name_file(source: Path) -> Iterator[None]:
    """Put the name of the file before the message of a ConfigError."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}", path=error.path) from error
