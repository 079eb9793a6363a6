"""What a command prints: aligned tables for people, one JSON object for programs."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

_WIDTH = 200  # where the output is no terminal
_WORDS = ("unit", "method", "computed by", "origin")  # columns of words are flush left

Facts: TypeAlias = list[tuple[str, Any, str]]  # quantity, value, unit


@dataclass(kw_only=True)
class TableText:
    """A table: a title, headings with units, and rows of cells."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Any]]


def fact_table(title: str, facts: Facts) -> TableText:
    """Make a table of facts: a quantity, its value, and its unit."""
    return TableText(title=title, headings=("quantity", "value", "unit"), rows=facts)


def tabulate(
    title: str, items: Iterable[Any], *columns: tuple[str, Callable[[Any], Any]]
) -> TableText:
    """Make a table of items from columns: a heading, and the cell of an item below it."""
    return TableText(
        title=title,
        headings=[heading for heading, _ in columns],
        rows=[[cell(item) for _, cell in columns] for item in items],
    )


@dataclass(kw_only=True)
class Report:
    """What a command reports, for programs and for people."""

    data: dict[str, Any]  # what ``--json`` prints; nan and inf become null
    tables: list[TableText] = field(default_factory=list)  # what people see
    notes: list[str] = field(default_factory=list)  # lines below the tables
    passed: bool = True  # False makes the exit status 1

    def note_written(self, path: str | os.PathLike[str], key: str = "file") -> None:
        """Add a file that was written to the data, and a line about it to the notes."""
        self.data[key] = str(path)
        self.notes.append(f"written: {path}")

    def print(self, *, as_json: bool) -> None:
        """Print to standard output."""
        if as_json:
            print(json.dumps(json_value(self.data), allow_nan=False))
            return
        console = Console(highlight=False, width=None if sys.stdout.isatty() else _WIDTH)
        for text in self.tables:
            console.print(_rich_table(text))
        for note in self.notes:
            console.print(note, markup=False, soft_wrap=True)


def _rich_table(text: TableText) -> Table:
    table = Table(title=Text(text.title, style="bold"), title_justify="left", box=SIMPLE_HEAD)
    for i, heading in enumerate(text.headings):
        words = heading in _WORDS
        table.add_column(Text(heading), justify="left" if i == 0 or words else "right")
    for row in text.rows:
        table.add_row(*(Text(cell_text(value)) for value in row))
    return table


def cell_text(value: Any) -> str:
    """Return the text of a cell, with at most six significant digits."""
    if value is None:
        return "-"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return "-" if math.isnan(value) else f"{float(value):.6g}"
    return str(value)


def format_fixed(value: float, digits: int) -> str:
    """Format a number with a fixed count of decimals, and nan as a dash."""
    return "-" if np.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"


def json_value(value: Any) -> Any:
    """Convert a value to the types that JSON has."""
    if isinstance(value, dict):
        return {str(k): json_value(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(v) for v in value]
    if isinstance(value, np.ndarray):
        return json_value(value.tolist())
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value
