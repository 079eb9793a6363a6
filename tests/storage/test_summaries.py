"""Objects in a debugger, when printed, and in a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from lbt_synth.storage.rows import column, fact_table, table_row
from lbt_synth.storage.summaries import Summarised, Summary
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
    tables: int = 1

    def _brief(self):
        return "a & b"

    def _summarise(self):
        table = fact_table("Facts", Facts(rms_nm=12.5, states=3))
        return Summary(tables=[table] * self.tables, notes=["x < y"])


def test_an_array_is_its_shape_in_one_line():
    assert repr(Plain(values=np.eye(40))) == "<Plain: values=array(40, 40), note='x'>"
    line = repr(Plain(values=np.eye(2), note="long\n" * 100))
    assert (len(line), line[-4:], "\n" in line) == (100, "...>", False)
    assert repr(Shown(values=np.eye(2))) == "<Shown: a & b>"


def test_printing_shows_the_facts_in_columns():
    shown = Shown(values=np.eye(2))
    assert str(shown).splitlines() == [
        "Shown: a & b",
        "  residual <all>  12.5  nm",
        "  states             3",
        "  x < y",
    ]
    assert shown.summary() == str(shown)
    assert ElementTree.fromstring(shown._repr_html_()).text == str(shown)  # in a notebook
    lines = str(Shown(values=np.eye(2), tables=2)).splitlines()
    assert lines.count("  Facts") == 2  # captions of several tables


def test_a_table_of_rows_keeps_its_headings():
    @dataclass(frozen=True, slots=True, kw_only=True, eq=False)
    class Listed(Summarised):
        def _summarise(self):
            return Summary(tables=[Table(caption="L", headings=("line", "f"), rows=(("a", "20"),))])

    assert str(Listed()).splitlines()[1:] == ["  line   f", "  a     20"]
