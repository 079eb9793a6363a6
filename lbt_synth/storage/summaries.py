"""What an object says of itself: a line in a debugger, some when it is printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from html import escape
from typing import Any

import numpy as np

from lbt_synth.storage.tables import Table, aligned

_LONGEST = 100  # characters of a line in a debugger


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What an object shows when it is printed."""

    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()


class Summarised:
    """An object whose ``repr`` is one line, and which shows its facts when it is printed.

    Notebooks show the same.
    """

    __slots__ = ()

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Keep the one line, in place of that of dataclasses, which has whole arrays."""
        super().__init_subclass__(**keywords)
        cls.__repr__ = Summarised.__repr__  # type: ignore[method-assign]

    def _brief(self) -> str:
        """Return what the object is, in some words."""
        values = ((each.name, getattr(self, each.name)) for each in fields(self))  # type: ignore[arg-type]
        return ", ".join(f"{name}={_short_text(value)}" for name, value in values)

    def _summarise(self) -> Summary:
        """Return the facts of the object."""
        return Summary()

    def __repr__(self) -> str:
        """Return one line."""
        line = f"<{type(self).__name__}: {self._brief()}>"
        return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 4]}...>"

    def __str__(self) -> str:
        """Return the summary."""
        return self.summary()

    def summary(self) -> str:
        """Return the facts of the object as text, as ``print`` shows them."""
        found = self._summarise()
        lines = [f"{type(self).__name__}: {self._brief()}"]
        for table in found.tables:
            lines += _text_lines(table, titled=len(found.tables) > 1)
        return "\n".join([*lines, *(f"  {note}" for note in found.notes)])

    def _repr_html_(self) -> str:
        """Return the summary for notebooks, which would show one line."""
        return f"<pre>{escape(self.summary())}</pre>"


def _short_text(value: Any) -> str:
    """Return a value in one line, an array by its shape."""
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if isinstance(value, tuple | list) and len(value) > 2:
        return f"{len(value)} entries"
    return f"{value:.6g}" if isinstance(value, float | np.floating) else repr(value)


def _text_lines(table: Table, *, titled: bool) -> list[str]:
    """Return a table as aligned lines: the rows alone, or with the caption and headings."""
    rows = [tuple(cell.text for cell in row) for row in table.cells()]
    caption = [f"  {table.caption}"] if titled else []
    is_fact = table.headings == ("quantity", "value", "unit")  # which says no more
    shown = rows if is_fact else [table.headings, *rows]
    widths = [max(map(len, cells)) for cells in zip(*shown, strict=True)]
    return caption + [f"  {'  '.join(row)}".rstrip() for row in aligned(shown, widths, table)]
