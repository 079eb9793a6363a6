"""Standard output and standard error, which may be closed, full or a terminal that obeys."""

from __future__ import annotations

import codecs
import contextlib
import os
import re
import sys

# control characters, of writing directions too, and halves of letters in names of files
_UNPRINTABLE = re.compile(
    "[\0-\x08\n-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


# what an encoding without them gets instead
_PLAIN = {
    "\u2212": "-",
    "\u2013": "-",
    "\u2014": "-",
    "\u2026": "...",
    "\u00d7": "x",
    "\u00b1": "+-",
    "\u00b5": "u",
    "\u03bc": "u",
    "\u00b2": "^2",
    "\u00b0": " deg",
    "\u2264": "<=",
    "\u2265": ">=",
    "\u2018": "'",
    "\u2019": "'",
    "\u201c": '"',
    "\u201d": '"',
    "\u00a0": " ",
    "\u2500": "-",
    "\u221e": "inf",
    "\u221a": "sqrt",
    "\u00b7": "*",
    "\u03c3": "sigma",
}
_PLAIN_ERRORS = "lbt_synth.plain"  # a handler of errors, as "backslashreplace" is one


def _write_plainly(error: UnicodeError) -> tuple[str, int]:
    """Return other words for characters that an encoding lacks, else their escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    strange = error.object[error.start : error.end]
    plain = [_PLAIN.get(c) or c.encode("ascii", "backslashreplace").decode() for c in strange]
    return "".join(plain), error.end


codecs.register_error(_PLAIN_ERRORS, _write_plainly)


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


def reopen_closed() -> None:
    """Let nothing stand in for closed standard streams, so that no file that is opened does."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:  # the least free number is taken, which is this one
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
            setattr(sys, name, open(number, "r" if number == 0 else "w"))  # noqa: PTH123, SIM115
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors=_PLAIN_ERRORS)  # type: ignore[union-attr]


def discard(number: int) -> None:
    """Let nothing take what else is written to a stream, so that it ends without an error."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
