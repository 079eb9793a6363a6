"""Pages as files: the same page is the same file, and a PDF needs its extra."""

import re
import sys

import pytest
from support.pages import HOSTILE, whole_page

import lbt_synth as lbt
from lbt_synth.report.page.html import page_html
from lbt_synth.report.page.page_files import print_html, require_page_names, write_page


def test_the_same_page_is_the_same_file():
    assert page_html(whole_page()) == page_html(whole_page())


def test_without_the_extra_a_pdf_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    said = r'a page as PDF needs WeasyPrint and Pango: pip install "lbt-synth\[pdf\]"'
    with pytest.raises(lbt.errors.MissingExtraError, match=said) as caught:
        require_page_names(tmp_path / "a.html", tmp_path / "a.pdf")
    assert caught.value.extra == "pdf"
    require_page_names(tmp_path / "a.html")


@pytest.mark.e2e
def test_a_pdf_has_sheets_of_a4_and_no_date(tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")  # fonts have one
    files = write_page(whole_page(), tmp_path / "a.html", tmp_path / "a.pdf")
    assert [path.name for path in files] == ["a.html", "a.pdf"]
    pdf = files[1].read_bytes()
    assert pdf.startswith(b"%PDF")
    assert b"CreationDate" not in pdf
    for box in re.findall(rb"/MediaBox\s*\[(.*?)\]", pdf):
        assert [float(x) for x in box.split()] == pytest.approx([0, 0, 595.28, 841.89], abs=0.1)
    assert print_html(files[0].read_bytes()) == pdf
    assert print_html(page_html(whole_page(HOSTILE))).startswith(b"%PDF")
