"""A page on sheets of A4, drawn by matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from lbt_synth.report.page.blocks import Block, Listing, Notice, Page, Paragraph, Section
from lbt_synth.report.page.charts import Chart, Panel
from lbt_synth.report.page.line_breaking import (
    BODY,
    BOLD,
    LINE,
    MONO,
    Style,
    mono_lines,
    text_width,
    wrap,
)
from lbt_synth.report.page.matplotlib_charts import chart_height, chart_style, draw_chart
from lbt_synth.storage.tables import Cell, Table

WIDTH, HEIGHT = 8.27, 11.69  # A4 [inch]
_SIDE, _TOP, _BOTTOM = 0.635, 0.6, 0.65
INSIDE = WIDTH - 2 * _SIDE
_COLUMNS = 6  # that fit beside the first one of a table
_ROOM = HEIGHT - _TOP - _BOTTOM - 0.5  # of a sheet below the heading of a section [inch]
_TOGETHER = 12  # lines of a paragraph or rows of a table that stay on one sheet
_PAD = 0.05  # around the text of a cell
_INKS = {"bad": "#a40e26", "good": "#116329", "note": "#6a4b00", "plain": "#1b1f24"}
_TINTS = {"bad": "#fdecee", "good": "#e9f5ec", "note": "#fff6dc"}
Draw = Callable[[Any], None]


def page_pdf(page: Page) -> bytes:
    """Return a page as a PDF of A4 sheets.

    The first section stands on the title page. Without a date, the same page is the same file.
    """
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    with chart_style():
        sheets = _Sheets()
        sheets.add_words(page.title, Style(size=19, weight="bold"), after=0.08)
        sheets.add_words(page.subtitle, Style(size=9, ink="#4a5560"), after=0.25)
        for number, section in enumerate(page.sections):
            sheets.add_section(section, first=number == 0)
        buffer = io.BytesIO()
        facts = {
            "Title": page.title,
            "Author": page.creator,
            "Creator": page.creator,
            "CreationDate": None,
        }
        with PdfPages(buffer, metadata=facts) as pdf:
            for number, draws in enumerate(sheets.pages):
                figure = Figure(figsize=(WIDTH, HEIGHT))
                for draw in draws:
                    draw(figure)
                foot = f"page {number + 1} of {len(sheets.pages)}"
                _draw_text(figure, WIDTH - _SIDE - text_width(foot, LINE), 0.35, foot, LINE)
                room = INSIDE - text_width(foot, LINE) - 0.3
                _draw_text(figure, _SIDE, 0.35, wrap(page.title, LINE, room)[0], LINE)
                pdf.savefig(figure)
    return buffer.getvalue()


class _Sheets:
    """Sheets that are filled from the top, and the drawings on each of them."""

    def __init__(self) -> None:
        self.pages: list[list[Draw]] = [[]]
        self.y = HEIGHT - _TOP

    def take(self, height: float) -> float:
        """Return the top of a place of that height, on a new sheet if there is no room."""
        if self.y - height < _BOTTOM and self.pages[-1]:
            self.pages.append([])
            self.y = HEIGHT - _TOP
        top = self.y
        self.y -= height
        return top

    def make_room(self, height: float) -> bool:
        """Go on to a new sheet if there is no such height left, and return whether it is so."""
        missing = self.y - height < _BOTTOM
        if missing:
            self.y = 0.0
        return missing

    def draw(self, what: Draw) -> None:
        self.pages[-1].append(what)

    def draw_line(self, text: str, style: Style, *, top: float, left: float = _SIDE) -> None:
        self.draw(partial(_draw_line, top=top, left=left, text=text, style=style))

    def add_section(self, section: Section, *, first: bool) -> None:
        """Set a section; its heading is not left alone at the foot of a sheet."""
        head = Style(size=14, weight="bold")
        opening = 0.0
        for block in section.blocks:  # up to the first thing that is no text
            first_part = next(split_by_sheets(block)) if isinstance(block, Chart) else block
            opening += block_height(first_part)
            if not isinstance(block, Paragraph | Notice):
                break
        if not first:
            self.make_room(0.45 + min(opening, _ROOM))
        self.add_words(section.title, head, after=0.1)
        for block in section.blocks:
            self.add_block(block)
        self.y -= 0.15

    def add_block(self, block: Block) -> None:
        if isinstance(block, Paragraph):
            self.add_words(block.text, BODY, after=0.1)
        elif isinstance(block, Notice):
            self.add_notice(block)
        elif isinstance(block, Listing):
            self.add_listing(block)
        elif isinstance(block, Table):
            for part in block.by_columns(_COLUMNS):
                self.add_table(part)
        else:
            for chart in split_by_sheets(block):
                self.add_chart(chart)

    def add_words(self, text: str, style: Style, *, after: float) -> None:
        """Set a text; a short one is kept together."""
        lines = wrap(text, style, INSIDE)
        if len(lines) <= _TOGETHER:
            self.make_room(len(lines) * style.leading)
        for line in lines:
            self.draw_line(line, style, top=self.take(style.leading))
        self.y -= after

    def add_notice(self, notice: Notice) -> None:
        style = Style(
            size=9, weight="bold" if notice.tone == "bad" else "normal", ink=_INKS[notice.tone]
        )
        lines = wrap(notice.text, style, INSIDE - 0.3)
        height = len(lines) * style.leading + 0.16
        top = self.take(height + 0.1)
        tint = _TINTS.get(notice.tone, "#f4f6f8")
        self.draw(partial(_draw_box, left=_SIDE, top=top, width=INSIDE, height=height, shade=tint))
        self.draw(
            partial(
                _draw_box, left=_SIDE, top=top, width=0.05, height=height, shade=_INKS[notice.tone]
            )
        )
        for i, line in enumerate(lines):
            at = top - 0.08 - i * style.leading
            self.draw_line(line, style, top=at, left=_SIDE + 0.18)

    def add_listing(self, listing: Listing) -> None:
        lines = mono_lines(listing.text, INSIDE)
        self.take(BOLD.leading + 4 * MONO.leading)  # not the heading alone
        self.y += BOLD.leading + 4 * MONO.leading
        self.add_words(listing.caption, BOLD, after=0.05)
        for line in lines:
            self.draw_line(line, MONO, top=self.take(MONO.leading))
        self.y -= 0.1

    def add_chart(self, chart: Chart) -> None:
        caption = wrap(chart.caption, LINE, INSIDE)
        title = wrap(chart.title, BOLD, INSIDE)
        top = self.take(block_height(chart))
        for line in title:
            self.draw_line(line, BOLD, top=top)
            top -= BOLD.leading
        top -= 0.05
        self.draw(partial(draw_chart, chart=chart, left=_SIDE, top=top, width=INSIDE))
        top -= chart_height(chart, INSIDE) + 0.05
        for line in caption:
            self.draw_line(line, LINE, top=top)
            top -= LINE.leading

    def add_table(self, table: Table) -> None:
        """Set a table, its headings repeated on each sheet."""
        rows = list(table.cells())
        head = tuple(Cell(text=text) for text in table.headings)
        widths = column_widths([head, *rows])
        top_row = _Row(head, widths, table.words, heading=True)
        body = [_Row(cells, widths, table.words) for cells in rows]
        kept = body if len(body) <= _TOGETHER else body[:1]
        start = top_row.height + sum(row.height for row in kept)
        self.make_room(start + BOLD.leading + 0.1)
        self.add_words(table.caption, BOLD, after=0.03)
        self.add_row(top_row)
        for row in body:
            if self.make_room(row.height):
                self.add_row(top_row)
            self.add_row(row)
        self.y -= 0.2

    def add_row(self, row: _Row) -> None:
        self.draw(partial(row.draw, top=self.take(row.height)))


class _Row:
    """A row of a table with its cells wrapped."""

    def __init__(
        self,
        cells: tuple[Cell, ...],
        widths: list[float],
        words: tuple[int, ...],
        *,
        heading: bool = False,
    ) -> None:
        self.cells, self.words, self.heading = cells, words, heading
        self.group = len(cells) == 1 and len(widths) > 1
        self.widths = [sum(widths)] if self.group else widths
        self.lines = [
            wrap(cell.text, self._style(cell), width - 2 * _PAD)
            for cell, width in zip(cells, self.widths, strict=True)
        ]
        self.height = max(len(lines) for lines in self.lines) * LINE.leading + 0.07

    def _style(self, cell: Cell) -> Style:
        bold = self.heading or self.group or cell.tone == "bad"
        return Style(size=LINE.size, weight="bold" if bold else "normal", ink=_INKS[cell.tone])

    def draw(self, figure: Any, *, top: float) -> None:
        """Draw the row on a sheet."""
        left = _SIDE
        bottom = top - self.height
        if self.group:
            _draw_box(
                figure,
                left=left,
                top=top,
                width=sum(self.widths),
                height=self.height,
                shade="#f4f6f8",
            )
        for i, (cell, lines, width) in enumerate(
            zip(self.cells, self.lines, self.widths, strict=True)
        ):
            style = self._style(cell)
            if cell.tone == "bad":
                _draw_box(
                    figure, left=left, top=top, width=width, height=self.height, shade=_TINTS["bad"]
                )
            for j, line in enumerate(lines):
                at = left + _PAD
                if i > 0 and i not in self.words:
                    at = left + width - _PAD - text_width(line, style)
                _draw_line(
                    figure, top=top - 0.035 - j * style.leading, left=at, text=line, style=style
                )
            left += width
        thickness = 0.012 if self.heading else 0.005
        _draw_box(
            figure,
            left=_SIDE,
            top=bottom + thickness,
            width=left - _SIDE,
            height=thickness,
            shade="#1b1f24" if self.heading else "#c9d1d9",
        )


def split_by_sheets(chart: Chart) -> Iterator[Chart]:
    """Yield charts that each fit a sheet below the heading of a section, in whole rows."""
    panels = chart.panels
    parts: list[tuple[Panel, ...]] = [()]
    for start in range(0, len(panels), chart.columns):
        row = panels[start : start + chart.columns]
        longer = replace(chart, panels=parts[-1] + row)
        if parts[-1] and block_height(longer) > _ROOM:
            parts.append(row)
        else:
            parts[-1] += row
    for number, part in enumerate(parts):
        more = f"{chart.title} (continued)" if number else chart.title
        yield replace(chart, title=more, panels=part)


def block_height(block: Block) -> float:
    """Height that a block needs on one sheet [inch]; that of its start for a table or listing."""
    if isinstance(block, Chart):
        caption, title = wrap(block.caption, LINE, INSIDE), wrap(block.title, BOLD, INSIDE)
        words = len(caption) * LINE.leading + len(title) * BOLD.leading
        return chart_height(block, INSIDE) + words + 0.35
    if isinstance(block, Table | Listing):
        return 1.0
    return len(wrap(block.text, BODY, INSIDE)) * BODY.leading + 0.2


def column_widths(rows: list[tuple[Cell, ...]]) -> list[float]:
    """Widths of columns [inch] that fit the sheet; the widest are narrowed and their text wraps."""
    bold = Style(size=LINE.size, weight="bold")
    count = max(len(row) for row in rows)
    natural = [
        max(text_width(row[i].text, bold) for row in rows if len(row) == count) + 2 * _PAD + 0.02
        for i in range(count)
    ]
    cap = INSIDE
    while sum(min(width, cap) for width in natural) > INSIDE:
        cap *= 0.98
    return [min(width, cap) for width in natural]


def _draw_text(figure: Any, x: float, y: float, text: str, style: Style) -> None:
    figure.text(
        x,
        y,
        text,
        transform=figure.dpi_scale_trans,
        fontsize=style.size,
        color=style.ink,
        fontweight=style.weight,
        family=style.family,
        va="baseline",
    )


def _draw_line(figure: Any, *, top: float, left: float, text: str, style: Style) -> None:
    _draw_text(figure, left, top - 0.8 * style.leading, text, style)


def _draw_box(
    figure: Any, *, left: float, top: float, width: float, height: float, shade: str
) -> None:
    from matplotlib.patches import Rectangle

    figure.add_artist(
        Rectangle(
            (left, top - height),
            width,
            height,
            transform=figure.dpi_scale_trans,
            facecolor=shade,
            edgecolor="none",
            zorder=0,
        )
    )
