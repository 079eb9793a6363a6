"""Pages as files: the same page is the same file."""

from __future__ import annotations

import pytest
from support.pages import whole_page

from lbt_synth.report.page.html import page_html
from lbt_synth.report.page.pdf import page_pdf


@pytest.fixture(scope="module")
def plain():
    return page_html(whole_page()).decode()


@pytest.fixture(scope="module")
def sheets():
    return page_pdf(whole_page())


def test_the_same_page_is_the_same_file(plain, sheets):
    assert page_html(whole_page()).decode() == plain
    assert page_pdf(whole_page()) == sheets
