"""Spinners and progress bars on standard error, where that is a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def show_spinner(what: str, *, quiet: bool) -> Iterator[None]:
    """Show a spinner while the block runs."""
    if quiet or not sys.stderr.isatty():
        yield
        return
    from rich.console import Console  # slow to import where nobody looks

    console = Console(stderr=True)
    with console.status(what, spinner="line" if console.options.ascii_only else "dots"):
        yield


def track_progress(items: Iterable[Any], *, total: int, what: str, quiet: bool) -> Iterator[Any]:
    """Yield items and show how many have passed."""
    with count_progress(total=total, what=what, quiet=quiet) as count:
        for item in items:
            yield item
            count(1)


@contextmanager
def count_progress(*, total: int, what: str, quiet: bool) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a bar, which is shown after two seconds."""
    if quiet or not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich import progress as bars
    from rich.console import Console

    start, console = time.monotonic(), Console(stderr=True)
    shown = bars.TextColumn("{task.description}"), bars.BarColumn(), bars.MofNCompleteColumn()
    with bars.Progress(*shown, bars.TimeRemainingColumn(), console=console, transient=True) as bar:
        task = bar.add_task(what, total=total, visible=False)
        yield lambda done: bar.update(task, advance=done, visible=time.monotonic() - start > 2)
