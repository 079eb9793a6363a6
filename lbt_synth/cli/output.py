"""What a command prints: aligned tables for people, one JSON object for programs."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

_WIDE = 200
_WORDS = ("unit", "method", "computed by", "origin")  # columns of words, set flush left


@dataclass(kw_only=True)
class TableText:
    """A table: a title, headings with units, rows of cells."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(kw_only=True)
class Report:
    """Result of a command."""

    data: dict[str, Any]  # What ``--json`` prints; nan and inf become null
    tables: list[TableText] = field(default_factory=list)  # What people see
    notes: list[str] = field(default_factory=list)  # Lines below the tables
    passed: bool = True  # False makes the exit status 1

    def print(self, *, as_json: bool) -> None:
        """Print to standard output."""
        if as_json:
            print(json.dumps(plain(self.data), allow_nan=False))
            return
        console = Console(highlight=False, width=None if sys.stdout.isatty() else _WIDE)
        for text in self.tables:
            console.print(_table(text))
        for note in self.notes:
            console.print(note, markup=False, soft_wrap=True)


def _table(text: TableText) -> Table:
    table = Table(title=Text(text.title, style="bold"), title_justify="left", box=SIMPLE_HEAD)
    for i, heading in enumerate(text.headings):
        words = heading in _WORDS
        table.add_column(Text(heading), justify="left" if i == 0 or words else "right")
    for row in text.rows:
        table.add_row(*(Text(cell(value)) for value in row))
    return table


def cell(value: Any) -> str:
    """Text of one cell; six significant digits at most."""
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        number = float(value)
        if math.isnan(number):
            return "-"
        return f"{number:.6g}"
    return str(value)


def fixed(value: float, digits: int) -> str:
    """Return a number with a fixed count of decimals, a dash where there is none."""
    return "-" if np.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"


def plain(value: Any) -> Any:
    """Value made of what JSON knows."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value


@contextmanager
def working(what: str, *, quiet: bool) -> Iterator[None]:
    """Turn a spinner on standard error while the block works, when that is a terminal."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield
        return
    with console.status(what):
        yield


def progress(items: Iterable[Any], *, total: int, what: str, quiet: bool) -> Iterator[Any]:
    """Pass items on with a bar on standard error, when that is a terminal."""
    with _bar(quiet=quiet) as bar:
        yield from bar.track(items, total=total, description=what)


@contextmanager
def counting(
    *, total: int, what: str, quiet: bool, rate: bool = False
) -> Iterator[Callable[[int], None]]:
    """Give a function that counts what is done, for a bar that shows after two seconds."""
    start = time.monotonic()
    with _bar(quiet=quiet, rate=rate) as bar:
        task = bar.add_task(what, total=total, visible=False)

        def count(done: int) -> None:
            bar.update(task, advance=done, visible=time.monotonic() - start > 2)

        yield count


class _Rate(ProgressColumn):
    """How many a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.4g}/s")


def _bar(*, quiet: bool, rate: bool = False) -> Progress:
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        *([_Rate()] if rate else []),
        TimeRemainingColumn(),
        console=console,
        disable=quiet or not console.is_terminal,
        transient=True,
    )
