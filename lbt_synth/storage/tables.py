"""Tables of text cells, as lines and as CSV files."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from textwrap import wrap
from typing import Any

_LONGEST_NUMBER = 20  # letters; a longer word may be broken
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # how the cells begin that spreadsheets compute


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A cell of a table with a tone beside its text."""

    text: str
    tone: str = "plain"  # or good, bad, note; the text must say the same


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table; the first cell of each row is its heading."""

    caption: str
    headings: tuple[str, ...]  # one per column, the first over the headings of the rows
    rows: tuple[tuple[str | Cell, ...], ...]  # a single cell is a heading of the rows below
    words: tuple[int, ...] = ()  # columns set flush left, besides the first
    gap: int = 3  # letters between columns of text

    def cells(self) -> Iterator[tuple[Cell, ...]]:
        """Rows with every text as a cell."""
        for row in self.rows:
            yield tuple(Cell(text=c) if isinstance(c, str) else c for c in row)

    def by_columns(self, most: int) -> Iterator[Table]:
        """Split into tables of at most so many columns after the first, which each repeats."""
        count = len(self.headings)
        for start in range(1, max(count, 2), most):
            part = self.picked(range(start, min(start + most, count)))
            yield part if start == 1 else replace(part, caption=f"{self.caption} (continued)")

    def picked(self, columns: Sequence[int]) -> Table:
        """Return the table with the first column and some others."""
        return replace(
            self,
            headings=(self.headings[0], *(self.headings[c] for c in columns)),
            rows=tuple(
                row if len(row) == 1 else (row[0], *(row[c] for c in columns)) for row in self.rows
            ),
            words=tuple(i + 1 for i, c in enumerate(columns) if c in self.words),
        )


def aligned(rows: Iterable[Sequence[str]], widths: Sequence[int], table: Table) -> list[list[str]]:
    """Return the cells of rows as wide as their columns; words are flush left, numbers right."""
    flush = ["<" if i in (0, *table.words) else ">" for i in range(len(widths))]
    columns = list(zip(flush, widths, strict=True))
    return [
        [f"{cell:{side}{width}}" for cell, (side, width) in zip(row, columns, strict=True)]
        if len(row) == len(columns)
        else list(row)
        for row in rows
    ]


def text_lines(table: Table, room: int, *, rule: str = "─") -> list[str]:
    """Set a table in as many parts as its numbers need, each with all rows and some columns."""
    parts = [table]
    for most in range(max(len(table.headings) - 1, 1), 0, -1):
        parts = list(table.by_columns(most))
        if all(least_width(part) <= room for part in parts):
            break
    return [line for part in parts for line in _part_lines(part, room, rule)]


def least_width(table: Table) -> int:
    """Width of a table in which no name and no number is broken."""
    return sum(_widths(table)[1]) + _frame(table)


def _frame(table: Table) -> int:
    """Width of what stands around and between the columns."""
    return table.gap * len(table.headings) + 1


def _widths(table: Table) -> tuple[list[int], list[int]]:
    """Widths of the columns in which no cell is broken, and in which no number is."""
    columns = [
        [heading, *(row[i].text for row in table.cells() if i < len(row) > 1)]
        for i, heading in enumerate(table.headings)
    ]
    names = [" ".join(columns[0]), *(heading for heading, *_ in columns[1:])]
    least = [
        max([0, *map(len, name.split()), *(min(len(word), _LONGEST_NUMBER) for word in words)])
        for name, words in zip(names, (" ".join(column).split() for column in columns), strict=True)
    ]
    return [max(map(len, c)) for c in columns], least


def _part_lines(table: Table, room: int, rule: str) -> list[str]:
    """Set a table; the widest headings are broken first, then words, and numbers last."""
    widths, least = _widths(table)
    bodies, _ = _widths(replace(table, headings=("",) * len(widths)))
    while sum(widths) > room - _frame(table) and max(widths) > 1:
        wide = [i for i, width in enumerate(widths) if width > least[i]]
        broken = [i for i in wide if widths[i] > bodies[i]] or wide or range(len(widths))
        widths[max(broken, key=widths.__getitem__)] -= 1
    lines = []
    for row in (table.headings, *(tuple(cell.text for cell in row) for row in table.cells())):
        whole = row if len(row) == len(widths) else (*row, *[""] * (len(widths) - len(row)))
        cells = [wrap(text, max(width, 1)) for text, width in zip(whole, widths, strict=True)]
        pieces = aligned(zip_longest(*cells, fillvalue=""), widths, table)
        lines += [f"  {(table.gap * ' ').join(piece)}".rstrip() for piece in pieces]
        if len(lines) == len(pieces):
            lines.append(f" {rule * (sum(widths) + _frame(table) - 2)}")
    return [*wrap(table.caption, room), "", *lines, ""]


def csv_bytes(headings: Sequence[str], rows: Sequence[Sequence[Any]]) -> bytes:
    r"""Return a CSV table as UTF-8, floats with all their digits."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerows([_plain_cell(cell) for cell in row] for row in (headings, *rows))
    return buffer.getvalue().encode(errors="backslashreplace")


def _plain_cell(cell: Any) -> Any:
    """Put an apostrophe before a text that a spreadsheet would take for a formula and run."""
    if not isinstance(cell, str) or not cell.startswith(_FORMULA):
        return cell
    with contextlib.suppress(ValueError):
        float(cell)
        return cell
    return cell if cell in _FORMULA else f"'{cell}"
