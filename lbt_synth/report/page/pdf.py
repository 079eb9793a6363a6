"""A page on sheets of A4, set by fpdf2."""

from __future__ import annotations

import io
import logging
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from lbt_synth.report.charts.description import Chart, Map, Panel
from lbt_synth.report.charts.matplotlib_charts import chart_png, chart_svg
from lbt_synth.report.charts.paper_layout import lay_out
from lbt_synth.report.number_text import print_text, unbroken_text
from lbt_synth.report.page.blocks import Block, Listing, Notice, Page, Paragraph, Section
from lbt_synth.report.provenance import creator_name
from lbt_synth.storage.tables import Cell, Table

if TYPE_CHECKING:
    from fpdf import FPDF

WIDTH, HEIGHT = 8.27, 11.69  # A4 [inch]
_SIDE, _TOP, _BOTTOM = 0.635, 0.6, 0.65
INSIDE = WIDTH - 2 * _SIDE
_COLUMNS = 6  # that fit beside the first one of a table
_ROOM = HEIGHT - _TOP - _BOTTOM - 0.5  # of a sheet below the heading of a section [inch]
_TOGETHER = 12  # rows of a table that stay on one sheet
_LISTING, _LEAST_LISTING = 7.0, 5.6  # points of the type of a listing
_PAD = 0.05  # around the text of a cell [inch]
_INKS = {"bad": "#a40e26", "good": "#116329", "note": "#6a4b00", "plain": "#1b1f24"}
_TINTS = {"bad": "#fdecee", "good": "#e9f5ec", "note": "#fff6dc", "plain": "#f4f6f8"}
_DATE = re.compile(rb"/CreationDate \([^)]*\)")
_PIXELS = re.compile(r"(font-size: [\d.]+)px")
_SANS, _MONO = "DejaVu Sans", "DejaVu Sans Mono"  # as in the drawings


def page_pdf(page: Page) -> bytes:
    """Return a page as a PDF of A4 sheets.

    The first section stands on the title page. Without a date, the same page is the same file.
    """
    import matplotlib as mpl
    from fpdf import FPDF

    class Sheets(FPDF):
        def footer(self) -> None:
            self.set_y(-0.45)
            _set_style(self, 8)
            title = page.title
            while self.get_string_width(title) > INSIDE - 1.2:
                title = title[: int(0.9 * len(title))] + "…"
            self.cell(INSIDE - 1.2, text=title)
            self.cell(1.2, text=f"page {self.page_no()} of {{nb}}", align="R")

    # a name in a script that the font does not have stays a name
    logging.getLogger("fpdf").setLevel(logging.ERROR)
    pdf = Sheets(unit="in", format=(WIDTH, HEIGHT))
    pdf.creation_date = datetime.fromtimestamp(0, UTC)  # blanked below
    pdf.set_title(page.title)
    pdf.set_author(creator_name())
    pdf.set_creator(creator_name())
    pdf.set_margins(_SIDE, _TOP)
    pdf.set_auto_page_break(auto=True, margin=_BOTTOM)
    pdf.c_margin = 0.0
    fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
    pdf.add_font(_SANS, "", fonts / "DejaVuSans.ttf")
    pdf.add_font(_SANS, "B", fonts / "DejaVuSans-Bold.ttf")
    pdf.add_font(_MONO, "", fonts / "DejaVuSansMono.ttf")
    pdf.add_page()
    _write(pdf, page.title, 19, bold=True, after=0.08)
    _write(pdf, page.subtitle, 9, ink="#4a5560", after=0.25)
    for number, section in enumerate(page.sections):
        _write_section(pdf, section, first=number == 0)
    # fpdf2 always writes a date; blanks of the same length leave all offsets as they are
    return _DATE.sub(lambda found: b" " * len(found[0]), bytes(pdf.output()))


def _set_style(
    pdf: FPDF, size: float, *, bold: bool = False, ink: str = _INKS["plain"], family: str = _SANS
) -> None:
    pdf.set_font(family, "B" if bold else "", size)
    pdf.set_text_color(ink)


def _leading(size: float) -> float:
    """Distance of lines [inch] of a size [points]."""
    return 1.35 * size / 72


def _write(
    pdf: FPDF,
    text: str,
    size: float,
    *,
    bold: bool = False,
    ink: str = _INKS["plain"],
    family: str = _SANS,
    after: float,
) -> None:
    """Write a text in lines as wide as the sheet; a short one is kept together."""
    from fpdf.enums import WrapMode

    _set_style(pdf, size, bold=bold, ink=ink, family=family)
    lines = len(text) / 90
    if lines < _TOGETHER and family != _MONO:
        _make_room(pdf, math.ceil(lines) * _leading(size))
    mode = WrapMode.CHAR if family == _MONO else WrapMode.WORD
    pdf.multi_cell(
        INSIDE, _leading(size), text, align="L", wrapmode=mode, new_x="LMARGIN", new_y="NEXT"
    )
    pdf.y += after


def _make_room(pdf: FPDF, height: float) -> None:
    """Go on to a new sheet if there is no such height left."""
    if pdf.y + height > HEIGHT - _BOTTOM and pdf.y > _TOP:
        pdf.add_page()


def _write_section(pdf: FPDF, section: Section, *, first: bool) -> None:
    """Set a section; its heading is not left alone at the foot of a sheet."""
    opening = 0.0
    for block in section.blocks:  # up to the first thing that is no text
        opening += block_height(_first_row(block) if isinstance(block, Chart) else block)
        if not isinstance(block, Paragraph | Notice):
            break
    if not first:
        _make_room(pdf, 0.45 + min(opening, _ROOM))
    _write(pdf, section.title, 14, bold=True, after=0.1)
    for block in section.blocks:
        match block:
            case Paragraph():
                _write(pdf, block.text, 9, after=0.1)
            case Notice():
                _write_notice(pdf, block)
            case Listing():
                _make_room(pdf, 0.8)  # not the heading alone
                _write(pdf, block.caption, 9, bold=True, after=0.05)
                text = block.text.expandtabs(4)
                _write(pdf, text, _listing_size(pdf, text), family=_MONO, after=0.1)
            case Table():
                for part in block.by_columns(_COLUMNS):
                    _write_table(pdf, part)
            case Chart():
                for chart in split_by_sheets(block, HEIGHT - _BOTTOM - pdf.y):
                    _write_chart(pdf, chart)
    pdf.y += 0.15


def _listing_size(pdf: FPDF, text: str) -> float:
    """Return the size of the type of a listing: smaller where it then ends on this sheet."""
    _set_style(pdf, _LISTING, family=_MONO)
    wide = int(INSIDE / pdf.get_string_width("0"))
    lines = sum(max(1, math.ceil(len(line) / wide)) for line in text.splitlines())
    room = HEIGHT - _BOTTOM - pdf.y
    fitting = 0.999 * _LISTING * room / (max(lines, 1) * _leading(_LISTING))
    return fitting if _LEAST_LISTING < fitting < _LISTING else _LISTING


def _write_notice(pdf: FPDF, notice: Notice) -> None:
    from fpdf.util import Padding

    ink, tint = _INKS[notice.tone], _TINTS[notice.tone]
    _set_style(pdf, 9, bold=notice.tone == "bad", ink=ink)
    _make_room(pdf, block_height(notice))
    pdf.set_fill_color(tint)
    top = pdf.y
    pdf.multi_cell(
        INSIDE,
        _leading(9),
        notice.text,
        align="L",
        fill=True,
        padding=Padding(0.08, 0.1, 0.08, 0.18),
        new_x="LMARGIN",
        new_y="NEXT",
    )
    pdf.set_fill_color(ink)
    pdf.rect(_SIDE, top, 0.05, pdf.y - top, style="F")
    pdf.set_fill_color("#000000")  # that of letters in drawings
    pdf.y += 0.1


def _write_chart(pdf: FPDF, chart: Chart) -> None:
    _make_room(pdf, block_height(chart))
    _write(pdf, chart.title, 9, bold=True, after=0.0)
    # fpdf2 knows neither the hatching nor the images in an SVG of a map
    mapped = any(panel.select(Map) for panel in chart.panels)
    # and takes a size in px for less than the unit of the drawing, which is a point
    drawing = chart_png(chart) if mapped else _PIXELS.sub(r"\1pt", chart_svg(chart)).encode()
    pdf.image(
        io.BytesIO(drawing),
        w=INSIDE,
        h=lay_out(chart.panels, chart.columns).height,
        alt_text=chart.alt,
    )
    pdf.y += 0.05
    _write(pdf, chart.caption, 8, after=0.2)


def _write_table(pdf: FPDF, table: Table) -> None:
    """Set a table, its headings repeated on each sheet."""
    from fpdf.fonts import FontFace

    rows = list(table.cells())
    head = tuple(Cell(text=print_text(text)) for text in table.headings)
    _make_room(pdf, 0.2 * (2 + min(len(rows), 3 if len(rows) > _TOGETHER else len(rows))))
    _write(pdf, print_text(table.caption), 9, bold=True, after=0.03)
    _set_style(pdf, 8)
    widths = _column_widths(pdf, [head, *rows])
    left = {0, *table.words}
    pdf.set_draw_color("#c9d1d9")
    pdf.set_line_width(0.005)
    with pdf.table(
        align="LEFT",
        width=sum(widths),
        col_widths=widths,
        text_align=tuple("LEFT" if i in left else "RIGHT" for i in range(len(widths))),
        line_height=_leading(8),
        padding=(0.035, _PAD),
        borders_layout="HORIZONTAL_LINES",
        headings_style=FontFace(emphasis="BOLD"),
        v_align="TOP",
    ) as grid:
        for cells in (head, *rows):
            row = grid.row()
            group = len(cells) == 1 and len(widths) > 1
            for i, cell in enumerate(cells):
                text = cell.text if i in left else unbroken_text(cell.text)
                tint = _TINTS["bad" if cell.tone == "bad" else "plain"]
                style = FontFace(
                    emphasis="BOLD" if cells is head or group or cell.tone == "bad" else None,
                    color=_INKS[cell.tone],
                    fill_color=tint if group or cell.tone == "bad" else "#ffffff",
                )
                row.cell(text, style=style, colspan=len(widths) if group else 1)
    pdf.y += 0.2


def _column_widths(pdf: FPDF, rows: list[tuple[Cell, ...]]) -> list[float]:
    """Widths of columns [inch] that fit the sheet; the widest are narrowed and their text wraps."""
    count = max(map(len, rows))
    _set_style(pdf, 8, bold=True)
    natural = [
        max(pdf.get_string_width(row[i].text) for row in rows if len(row) == count) + 2.4 * _PAD
        for i in range(count)
    ]
    _set_style(pdf, 8)
    cap = INSIDE
    while sum(min(width, cap) for width in natural) > INSIDE:
        cap *= 0.98
    return [min(width, cap) for width in natural]


def _first_row(chart: Chart) -> Chart:
    return replace(chart, panels=chart.panels[: chart.columns])


def split_by_sheets(chart: Chart, left_in: float = _ROOM) -> Iterator[Chart]:
    """Yield charts of whole rows that each fit a sheet below the heading of a section.

    The first one fits what is left of a sheet, if a row does.
    """
    parts: list[tuple[Panel, ...]] = [()]
    first = left_in if block_height(_first_row(chart)) <= left_in else _ROOM
    for start in range(0, len(chart.panels), chart.columns):
        row = chart.panels[start : start + chart.columns]
        room = _ROOM if len(parts) > 1 else first
        if parts[-1] and block_height(replace(chart, panels=parts[-1] + row)) > room:
            parts.append(row)
        else:
            parts[-1] += row
    for number, part in enumerate(parts):
        more = f"{chart.title} (continued)" if number else chart.title
        yield replace(chart, title=more, panels=part)


def block_height(block: Block) -> float:
    """Height that a block needs on one sheet [inch], or the start of a table or listing.

    That of a text is estimated by its letters.
    """
    match block:
        case Chart():
            words = math.ceil(len(block.caption) / 95) + math.ceil(len(block.title) / 75)
            return lay_out(block.panels, block.columns).height + words * _leading(8) + 0.35
        case Table() | Listing():
            return 1.0
    return math.ceil(len(block.text) / 80) * _leading(9) + 0.3
