"""What blocks, charts and tables refuse."""

import re

import pytest

import lbt_synth as lbt
from lbt_synth.report.charts.description import Axis, Bars, Chart, Curve, Map, Panel
from lbt_synth.report.page.blocks import Page, Section
from lbt_synth.storage.tables import Cell, Table

X, Y = Axis(label="x"), Axis(label="y")
DOT = Curve(name="a", x=[1.0], y=[1.0])


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Curve(name="a", x=[1, 2], y=[1]), "same length"),
        (lambda: Curve(name="a", x=[1], y=[1], line=False), "a line or a marker"),
        (lambda: Curve(name="a", x=[1], y=[1], marker="star"), "marker must be one of"),
        (lambda: Map(x=[1, 2], y=[1], values=[[1]], label="v"), "a column for each of 2 x"),
        (lambda: Map(x=[2, 1], y=[1], values=[[1, 2]], label="v"), "x of a map must increase"),
        (lambda: Map(x=[1], y=[1], values=[[1]], label="v", low=1), "low must be below high"),
        (
            lambda: Panel(x=X, y=Y, marks=(Bars(name="a", values=[1]),)),
            "a value for each of 0 categories",
        ),
        (
            lambda: Chart(key="A b", title="t", caption="c", alt="a", panels=()),
            "a key must be of small letters",
        ),
        (lambda: Chart(key="a", title="t", caption="c", alt=" ", panels=()), "words for its alt"),
        (lambda: Chart(key="a", title="t", caption="c", alt="a", panels=()), "one panel"),
        (lambda: Table(caption="t", headings=("a", "b", "c"), rows=(("1", "2"),)), "1 or 3 cells"),
        (lambda: Cell(text="a", tone="loud"), "tone must be one of"),
        (
            lambda: Page(
                title="t",
                subtitle="s",
                sections=tuple(Section(key="a", title="a", blocks=()) for _ in range(2)),
            ),
            "keys of a page must be unique; got a twice",
        ),
    ],
)
def test_mistakes_are_refused(make, text):
    with pytest.raises(lbt.errors.ProblemError, match=re.escape(text)):
        make()
