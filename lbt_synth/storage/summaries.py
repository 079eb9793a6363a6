"""What an object says of itself: a line in a debugger, some when printed, a table in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from html import escape
from typing import Any

import numpy as np

from lbt_synth.storage.tables import Table
from lbt_synth.validation import FloatArray

_WIDTH, _HEIGHT, _EDGE = 240, 64, 3  # of a sparkline [px]
_DECADES = 5.0  # below its peak that a sparkline shows
_LONGEST = 100  # characters of a line in a debugger


@dataclass(frozen=True, slots=True, kw_only=True)
class Sparkline:
    """A small curve on logarithmic axes."""

    caption: str
    frequency_hz: FloatArray  # (f,), above 0
    values: FloatArray  # (f,), at least 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What an object shows when it is printed."""

    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    curve: Sparkline | None = None


class Summarised:
    """An object whose ``repr`` is one line, and which shows its facts when it is printed.

    Notebooks show the same as a table, with a sparkline where there is a curve.
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
        """Return the summary as HTML, for notebooks."""
        found = self._summarise()
        parts = [f"<p><b>{type(self).__name__}</b>: {escape(self._brief())}</p>"]
        parts += [] if found.curve is None else [_draw_sparkline(found.curve)]
        parts += [_html_table(table, titled=len(found.tables) > 1) for table in found.tables]
        parts += [f"<p>{escape(note)}</p>" for note in found.notes]
        return f"<div>{''.join(parts)}</div>"


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
    shown = [table.headings, *rows] if _has_headings(table) else rows
    widths = [max(map(len, cells)) for cells in zip(*shown, strict=True)]
    left = (0, *table.words)
    cells = (
        [
            cell.ljust(width) if i in left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in shown
    )
    return caption + [f"  {'  '.join(row)}".rstrip() for row in cells]


def _has_headings(table: Table) -> bool:
    """Return whether the headings say more than that a line is a fact."""
    return table.headings != ("quantity", "value", "unit")


def _html_table(table: Table, *, titled: bool) -> str:
    caption = f"<caption>{escape(table.caption)}</caption>" if titled else ""
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in table.headings)
    head = f"<thead><tr>{head}</tr></thead>" if _has_headings(table) else ""
    body = "".join(
        f'<tr><th scope="row">{escape(first.text)}</th>'
        f"{''.join(f'<td>{escape(cell.text)}</td>' for cell in rest)}</tr>"
        for first, *rest in table.cells()
    )
    return f"<table>{caption}{head}<tbody>{body}</tbody></table>"


def _draw_sparkline(curve: Sparkline) -> str:
    """Return a curve as an inline SVG, its range in words below."""
    drawn = np.isfinite(curve.values) & (curve.values > 0)
    if np.count_nonzero(drawn) < 2:
        return ""
    x, y = np.log10(curve.frequency_hz[drawn]), np.log10(curve.values[drawn])
    y = np.maximum(y, np.max(y) - _DECADES)
    across = _EDGE + (_WIDTH - 2 * _EDGE) * (x - x[0]) / (x[-1] - x[0])
    down = _EDGE + (_HEIGHT - 2 * _EDGE) * (np.max(y) - y) / max(float(np.ptp(y)), 1e-9)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, down, strict=True))
    low, high = 10 ** np.min(y), 10 ** np.max(y)
    words = (
        f"{curve.caption}: {low:.3g} to {high:.3g}, from {curve.frequency_hz[0]:.3g} to "
        f"{curve.frequency_hz[-1]:.3g} Hz"
    )
    return (
        f'<figure><svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}" '
        f'viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(words)}">'
        f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.5"/></svg>'
        f"<figcaption>{escape(words)}</figcaption></figure>"
    )
