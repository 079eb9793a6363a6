"""Standard output and standard error: what they take, and the progress that a terminal shows."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any

_DISPLAY: ContextVar[Any] = ContextVar("display", default=None)  # where somebody looks


def printable(text: str) -> str:
    r"""Return a text in one line, with escapes for what a terminal would obey."""
    return "".join(
        c if c.isprintable() or c == "\t" else c.encode("unicode_escape").decode() for c in text
    )


def print_error(text: str) -> None:
    """Print one line to standard error, if that can be written."""
    with suppress(OSError):
        print(f"lbt-synth: {printable(text)}", file=sys.stderr, flush=True)


def discard(number: int) -> None:
    """Let nothing take what else is written to a stream, so that it ends without an error."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)


@contextmanager
def show_progress(command: str, *, quiet: bool) -> Iterator[None]:
    """Show the name of a command while it runs, and below it what it counts."""
    if quiet or not sys.stderr.isatty():
        yield
        return
    from rich import progress as bars  # slow to import where nobody looks
    from rich.console import Console

    console = Console(stderr=True)
    columns = (bars.TextColumn("{task.description}"), bars.BarColumn(), bars.TimeRemainingColumn())
    with bars.Progress(*columns, console=console, transient=True) as display:
        display.add_task(command, total=None)
        token = _DISPLAY.set(display)
        try:
            yield
        finally:
            _DISPLAY.reset(token)


def track_progress(items: Iterable[Any], *, total: int, what: str) -> Iterator[Any]:
    """Yield items and show how many have passed."""
    with count_progress(total=total, what=what) as count:
        for item in items:
            yield item
            count(1)


@contextmanager
def count_progress(*, total: int, what: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a bar."""
    display = _DISPLAY.get()
    if display is None:
        yield lambda done: None
        return
    task = display.add_task(what, total=total)
    yield lambda done: display.advance(task, done)
    display.remove_task(task)
