"""Objects in a debugger, when printed, and in a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import pytest

from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Sparkline, Summarised, Summary
from lbt_synth.storage.tables import Table


@table_row
class Facts:
    """Two numbers."""

    rms_nm: float = column("residual <all>", unit="nm")
    states: int = column("states")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plain(Summarised):
    values: np.ndarray
    note: str = "x"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown(Plain):
    curve: Sparkline | None = None
    tables: int = 1

    def _brief(self):
        return "a & b"

    def _summarise(self):
        table = fact_table("Facts", Facts(rms_nm=12.5, states=3))
        return Summary(tables=[table] * self.tables, notes=["x < y"], curve=self.curve)


def sparkline(values):
    return Sparkline(caption="gain <sigma>", frequency_hz=np.array([1.0, 10, 100]), values=values)


def html(shown):
    return ElementTree.fromstring(shown._repr_html_())


def test_an_array_is_its_shape_in_one_line():
    assert repr(Plain(values=np.eye(40))) == "<Plain: values=array(40, 40), note='x'>"
    line = repr(Plain(values=np.eye(2), note="long\n" * 100))
    assert len(line) == 100
    assert line.endswith("...>")
    assert "\n" not in line


def test_a_class_below_keeps_the_one_line():
    assert repr(Shown(values=np.eye(2))) == "<Shown: a & b>"


def test_printing_shows_the_facts_in_columns():
    assert str(Shown(values=np.eye(2))).splitlines() == [
        "Shown: a & b",
        "  residual <all>  12.5  nm",
        "  states             3",
        "  x < y",
    ]
    assert Shown(values=np.eye(2)).summary() == str(Shown(values=np.eye(2)))


def test_several_tables_have_their_captions():
    lines = str(Shown(values=np.eye(2), tables=2)).splitlines()
    assert lines.count("  Facts") == 2


def test_a_table_of_rows_keeps_its_headings():
    @dataclass(frozen=True, slots=True, kw_only=True, eq=False)
    class Listed(Summarised):
        def _summarise(self):
            return Summary(tables=[Table(caption="L", headings=("line", "f"), rows=(("a", "20"),))])

    assert str(Listed()).splitlines()[1:] == ["  line   f", "  a     20"]
    assert [cell.text for cell in html(Listed()).iter("th")] == ["line", "f", "a"]


def test_the_page_is_well_formed_and_says_the_same():
    page = html(Shown(values=np.eye(2), curve=sparkline(np.array([1.0, 3.0, 0.1]))))
    assert [cell.text for cell in page.iter("td")] == ["12.5", "nm", "3", None]
    assert [cell.text for cell in page.iter("th")] == ["residual <all>", "states"]
    assert "x < y" in [paragraph.text for paragraph in page.iter("p")]


def test_the_sparkline_is_drawn_on_logarithmic_axes():
    page = html(Shown(values=np.eye(2), curve=sparkline(np.array([1.0, 10.0, 0.1]))))
    (line,) = page.iter("{http://www.w3.org/2000/svg}polyline")
    points = [tuple(map(float, point.split(","))) for point in line.get("points").split()]
    assert points == [(3.0, 32.0), (120.0, 3.0), (237.0, 61.0)]
    (words,) = page.iter("figcaption")
    assert words.text == "gain <sigma>: 0.1 to 10, from 1 to 100 Hz"


@pytest.mark.parametrize("values", [[0.0, 0.0, 0.0], [np.nan, 1.0, np.inf]])
def test_no_sparkline_where_there_is_nothing_to_draw(values):
    page = html(Shown(values=np.eye(2), curve=sparkline(np.array(values))))
    assert list(page.iter("figure")) == []


def test_a_curve_that_falls_to_nothing_is_shown_over_five_decades():
    page = html(Shown(values=np.eye(2), curve=sparkline(np.array([1.0, 1e-30, 1.0]))))
    (words,) = page.iter("figcaption")
    assert words.text.startswith("gain <sigma>: 1e-05 to 1,")
