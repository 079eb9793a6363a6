"""What blocks, charts and tables refuse, and the time at which a page was made."""

import re
from datetime import UTC, datetime

import pytest
from matplotlib.figure import Figure

import lbt_synth as lbt
from lbt_synth.report.page.blocks import Chart, Page, creation_time
from lbt_synth.storage.tables import Cell, Table

WORDS = {"title": "t", "caption": "c", "alt": "a", "figure": Figure()}
CHART = Chart(key="a", **WORDS)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Table(caption="t", headings=("a", "b", "c"), rows=(("1", "2"),)), "1 or 3 cells"),
        (lambda: Cell(text="a", tone="loud"), "tone must be one of"),
        (
            lambda: Page(title="t", subtitle="s", sections={"a": ("a", [CHART])}),
            "keys of a page must be unique; got a twice",
        ),
    ],
)
def test_mistakes_are_refused(make, text):
    with pytest.raises(lbt.errors.ProblemError, match=re.escape(text)):
        make()


def test_a_section_without_blocks_is_left_out():
    sections = {"a": ("a", ()), "b": ("b", ("words",))}
    assert list(Page(title="t", subtitle="s", sections=sections).sections) == ["b"]


def test_the_creation_time(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert creation_time() == datetime(1970, 1, 2, tzinfo=UTC)
    for wrong in ("tomorrow", "1e400", str(10**30)):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)
        with pytest.raises(lbt.errors.ProblemError, match="SOURCE_DATE_EPOCH must be a number"):
            creation_time()
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert abs((datetime.now(UTC) - creation_time()).total_seconds()) < 60
