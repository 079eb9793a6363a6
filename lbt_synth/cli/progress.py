"""What is shown on standard error while a command runs, where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

_DISPLAY: ContextVar[Any] = ContextVar("display", default=None)  # where somebody looks


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
