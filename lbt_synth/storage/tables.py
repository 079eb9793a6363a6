"""Tables of text cells, and tables as CSV files."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from lbt_synth.errors import DimensionError
from lbt_synth.validation import choice, set_fields

TONES = ("plain", "good", "bad", "note")
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # how the cells begin that spreadsheets compute


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A cell of a table with a tone beside its text."""

    text: str
    tone: str = "plain"  # one of TONES; the text must say the same

    def __post_init__(self) -> None:
        choice(self.tone, "tone", TONES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table; the first cell of each row is its heading."""

    caption: str
    headings: tuple[str, ...]  # one per column, the first over the headings of the rows
    rows: tuple[tuple[str | Cell, ...], ...]  # a single cell is a heading of the rows below
    words: tuple[int, ...] = ()  # columns set flush left, besides the first

    def __post_init__(self) -> None:
        set_fields(self, headings=tuple(self.headings), rows=tuple(map(tuple, self.rows)))
        for row in self.rows:
            if len(row) not in (1, len(self.headings)):
                raise DimensionError(
                    f"a row of {self.caption!r} must have 1 or {len(self.headings)} cells; got "
                    f"{len(row)}."
                )

    def cells(self) -> Iterator[tuple[Cell, ...]]:
        """Rows with every text as a cell."""
        for row in self.rows:
            yield tuple(Cell(text=c) if isinstance(c, str) else c for c in row)

    def by_columns(self, most: int) -> Iterator[Table]:
        """Split into tables of at most so many columns after the first, which each repeats."""
        columns = range(1, len(self.headings))
        for start in range(1, max(len(self.headings), 2), most):
            chosen = [c for c in columns if start <= c < start + most]
            yield Table(
                caption=self.caption if start == 1 else f"{self.caption} (continued)",
                headings=(self.headings[0], *(self.headings[c] for c in chosen)),
                rows=tuple(
                    row if len(row) == 1 else (row[0], *(row[c] for c in chosen))
                    for row in self.rows
                ),
                words=tuple(i + 1 for i, c in enumerate(chosen) if c in self.words),
            )


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
