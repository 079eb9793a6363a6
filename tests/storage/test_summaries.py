"""Objects in a debugger, when printed, and in a notebook."""

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
    tables: tuple = ()

    def _brief(self):
        return "a & b"

    def _summarise(self):
        return Summary(tables=[*self.tables], notes=["x < y"])


FACTS = fact_table("Facts", Facts(rms_nm=12.5, states=3))
LINES = Table(caption="L", headings=("line", "f"), rows=(("a", "20"),))


def test_an_array_is_its_shape_in_one_line():
    assert repr(Plain(values=np.eye(40))) == "<Plain: values=array(40, 40), note='x'>"
    line = repr(Plain(values=np.eye(2), note="long\n" * 100))
    assert (len(line), line[-4:], "\n" in line) == (100, "...>", False)
    assert repr(Shown(values=np.eye(2))) == "<Shown: a & b>"


def test_printing_shows_the_facts_in_columns():
    shown, twice, listed = (
        Shown(values=np.eye(2), tables=tables) for tables in ((FACTS,), (FACTS, FACTS), (LINES,))
    )
    assert str(shown).splitlines() == [
        "Shown: a & b",
        "  residual <all>  12.5  nm",
        "  states             3",
        "  x < y",
    ]
    assert shown.summary() == str(shown)
    assert ElementTree.fromstring(shown._repr_html_()).text == str(shown)  # in a notebook
    assert str(twice).splitlines().count("  Facts") == 2  # captions of several tables
    assert str(listed).splitlines()[1:3] == ["  line   f", "  a     20"]  # headings stay
