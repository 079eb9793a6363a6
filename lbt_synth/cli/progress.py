"""Spinners and progress bars on standard error; without a terminal, a line now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from rich import progress as bars
from rich.console import Console
from rich.text import Text

from lbt_synth.cli.streams import print_error

_LINE_SECONDS = 30.0  # between two lines where there is no terminal


@contextmanager
def show_spinner(what: str, *, quiet: bool) -> Iterator[None]:
    """Show a spinner while the block runs, or without a terminal a line now and then."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        with _say_now_and_then(lambda: what, quiet=quiet):
            yield
        return
    with console.status(what, spinner="line" if console.options.ascii_only else "dots"):
        yield


@contextmanager
def _say_now_and_then(say: Callable[[], str], *, quiet: bool) -> Iterator[None]:
    """Print a line to standard error every half minute while the block runs."""
    over, start = threading.Event(), time.monotonic()

    def repeat() -> None:
        while not over.wait(_LINE_SECONDS):
            print_error(f"{say()}, {time.monotonic() - start:.0f} s so far")

    if quiet:
        yield
        return
    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def track_progress(items: Iterable[Any], *, total: int, what: str, quiet: bool) -> Iterator[Any]:
    """Yield items and show how many have passed."""
    with _progress_bar(quiet=quiet) as bar:
        yield from bar.track(items, total=total, description=what)


@contextmanager
def count_progress(
    *, total: int, what: str, quiet: bool, rate: bool = False
) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a bar, which a terminal shows after two seconds."""
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


@contextmanager
def _progress_bar(*, quiet: bool, rate: bool = False) -> Iterator[bars.Progress]:
    console = Console(stderr=True)
    hidden = quiet or not console.is_terminal
    console.quiet = hidden  # a bar that is disabled ends with an empty line in some versions
    bar = bars.Progress(
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        *([_RateColumn()] if rate else []),
        bars.TimeRemainingColumn(),
        console=console,
        disable=hidden,
        transient=True,
    )

    def say() -> str:
        return ", ".join(
            f"{task.description}: {task.completed:.0f} of {task.total or 0:.0f}"
            for task in bar.tasks
        )

    with bar, _say_now_and_then(say, quiet=quiet or console.is_terminal):
        yield bar
