"""Pages on sheets of A4: no date, and nothing that does not fit."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from fpdf import FPDF
from support.pages import HOSTILE, many_panels, whole_page

from lbt_synth.report.charts.description import Axis, Bars, Chart, Panel
from lbt_synth.report.page.blocks import Listing, Page, Paragraph, Section
from lbt_synth.report.page.pdf import HEIGHT, block_height, page_pdf, split_by_sheets
from lbt_synth.storage.tables import Table


@pytest.fixture(scope="module")
def sheets():
    return page_pdf(whole_page())


def pages_of(pdf):
    return len(re.findall(rb"/Type /Page\b", pdf))


def test_a_pdf_has_its_pages_and_no_date(sheets):
    pdf = sheets
    assert pdf.startswith(b"%PDF")
    assert pages_of(pdf) == 3
    assert b"CreationDate" not in pdf
    assert b"/Title (Page of first)" in pdf
    assert b"/MediaBox [0 0 595.44 841.68]" in pdf
    assert b"/Type3" not in pdf
    assert page_pdf(whole_page(HOSTILE)).startswith(b"%PDF")


@pytest.mark.parametrize("count", [1, 6, 7, 40])
def test_high_charts_continue_on_the_next_sheet(count):
    chart = many_panels(count)
    parts = list(split_by_sheets(chart))
    assert sum(len(part.panels) for part in parts) == count
    assert all(block_height(part) <= HEIGHT - 1.25 - 0.5 for part in parts)
    assert [part.title for part in parts[:2]] == ["Many", "Many (continued)"][: len(parts)]
    page = Page(
        title="t",
        subtitle="s",
        sections=(
            Section(key="a", title="A", blocks=(Paragraph(text="a"),)),
            Section(key="b", title="B", blocks=(chart,)),
        ),
    )
    assert pages_of(page_pdf(page)) == max(len(parts), 2 if count >= 6 else 1)


def test_a_chart_begins_on_what_is_left_of_a_sheet():
    panel = Panel(x=Axis(label="x"), y=Axis(label="y"), marks=())
    chart = Chart(key="c", title="t", caption="c", alt="a", panels=(panel,) * 3)
    row = block_height(replace(chart, panels=(panel,)))
    two = block_height(replace(chart, panels=(panel,) * 2))
    assert [len(part.panels) for part in split_by_sheets(chart, two)] == [2, 1]
    assert [len(part.panels) for part in split_by_sheets(chart, row)] == [1, 2]
    assert [len(part.panels) for part in split_by_sheets(chart, 0.9 * row)] == [3]


def test_bars_fit_a_sheet():
    names = tuple(f"parameter {i}" for i in range(60))
    bars = tuple(Bars(name=f"c{i}", values=np.ones(60), look=i) for i in range(3))
    panel = Panel(x=Axis(label="x", low=0), y=Axis(label="y"), marks=bars, categories=names)
    chart = Chart(key="bars", title="t", caption="c", alt="a", panels=(panel,))
    assert block_height(chart) <= HEIGHT - 1.25 - 0.5


def test_long_listings_and_tables_continue_on_the_next_sheet():
    def count(block):
        section = Section(key="a", title="A", blocks=(block,))
        page = Page(title="t", subtitle="s", sections=(section,))
        return pages_of(page_pdf(page))

    inside = HEIGHT - 0.6 - 0.65
    assert count(Listing(caption="l", text="line\n" * 10)) == 1
    used = 0.25 + 0.15 + 0.2 + 0.55 + 1000 * 1.35 * 7 / 72  # headings
    assert count(Listing(caption="l", text="line\n" * 1000)) == pytest.approx(
        np.ceil(used / inside), abs=1
    )
    # fewer than 70 lines of 7 points fit; up to a fourth more do in smaller type
    assert [count(Listing(caption="l", text="line\n" * n)) for n in (70, 76, 84, 94)] == [
        1,
        1,
        1,
        2,
    ]
    rows = tuple((f"row {i}", "value") for i in range(200))
    assert 3 <= count(Table(caption="t", headings=("a", "b"), rows=rows)) <= 5


def test_lines_fit_their_width():
    pdf = FPDF(unit="in")
    pdf.add_page()
    pdf.set_font("helvetica", size=9)
    pdf.c_margin = 0.0
    words = "some words and an_extremely_long_name_" + 80 * "x" + " and the end"
    lines = pdf.multi_cell(2.0, text=words, dry_run=True, output="LINES")
    assert all(pdf.get_string_width(line) <= 2.0 for line in lines)
    assert "".join(lines).replace(" ", "") == words.replace(" ", "")
    code = {"wrapmode": "CHAR", "dry_run": True, "output": "LINES"}
    assert all(
        pdf.get_string_width(line) <= 3.0 for line in pdf.multi_cell(3, text=200 * "m", **code)
    )
    assert pdf.multi_cell(3, text="a\n\nb", **code) == ["a", "", "b"]
