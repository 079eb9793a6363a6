"""Spinners and progress bars on standard error."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rich import progress as bars
from rich.console import Console
from rich.text import Text


@contextmanager
def show_spinner(what: str, *, quiet: bool) -> Iterator[None]:
    """Show a spinner while the block runs, if standard error is a terminal."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def track_progress(items: Iterable[Any], *, total: int, what: str, quiet: bool) -> Iterator[Any]:
    """Yield items and show how many have passed, if standard error is a terminal."""
    with _progress_bar(quiet=quiet) as bar:
        yield from bar.track(items, total=total, description=what)


@contextmanager
def count_progress(
    *, total: int, what: str, quiet: bool, rate: bool = False
) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a bar, which appears after two seconds."""
    start = time.monotonic()
    with _progress_bar(quiet=quiet, rate=rate) as bar:
        task = bar.add_task(what, total=total, visible=False)

        def count(done: int) -> None:
            bar.update(task, advance=done, visible=time.monotonic() - start > 2)

        yield count


class _RateColumn(bars.ProgressColumn):
    """Steps per second."""

    def render(self, task: bars.Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.4g}/s")


def _progress_bar(*, quiet: bool, rate: bool = False) -> bars.Progress:
    console = Console(stderr=True)
    return bars.Progress(
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        *([_RateColumn()] if rate else []),
        bars.TimeRemainingColumn(),
        console=console,
        disable=quiet or not console.is_terminal,
        transient=True,
    )
