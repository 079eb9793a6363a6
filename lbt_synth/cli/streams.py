"""Standard output and standard error, which may be full or a terminal that obeys."""

from __future__ import annotations

import contextlib
import os
import sys


def printable(text: str) -> str:
    r"""Return a text in one line, with escapes for what a terminal would obey."""
    return "".join(
        c if c.isprintable() or c == "\t" else c.encode("unicode_escape").decode() for c in text
    )


def print_error(text: str) -> None:
    """Print one line to standard error, if that can be written."""
    with contextlib.suppress(OSError):
        print(f"lbt-synth: {printable(text)}", file=sys.stderr, flush=True)


def discard(number: int) -> None:
    """Let nothing take what else is written to a stream, so that it ends without an error."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
