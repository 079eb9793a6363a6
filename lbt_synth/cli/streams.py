"""Standard output and standard error, which may be full, or a terminal that obeys."""

from __future__ import annotations

import contextlib
import os
import re
import sys

# control characters, of writing directions too, and halves of letters in names of files
_UNPRINTABLE = re.compile(
    "[\0-\x08\n-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


def printable(text: str) -> str:
    r"""Return a text in one line, with escapes for what a terminal would obey.

    Examples
    --------
    >>> from lbt_synth.cli.streams import printable
    >>> print(printable("\33[31mred\n café"))
    \x1b[31mred\n café
    """
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def print_error(text: str) -> None:
    """Print one line to standard error, if that can be written."""
    with contextlib.suppress(OSError):
        print(f"lbt-synth: {printable(text)}", file=sys.stderr, flush=True)


def discard(number: int) -> None:
    """Let nothing take what else is written to a stream, so that it ends without an error."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
