"""A page with every kind of block and mark, and what tests read out of pages."""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np

from lbt_synth.report.draw import PANEL_IN, drawing, square_in
from lbt_synth.report.page.html import Chart, Notice, Page
from lbt_synth.storage.tables import Cell, Table

HOSTILE = "</script><script>alert(1)</script><b>&\"'$x$ $$y$$ _z"
VOID = {"meta", "br", "hr", "img", "input", "link"}


class Reader(HTMLParser):
    """Elements of a page in their order, with what is inside; refuses what is not well formed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)
        self.close()
        assert self.stack == []

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        assert len(dict(attributes)) == len(attributes)
        if tag not in VOID:
            self.stack.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        for tag in set(self.stack):
            self.texts[tag][-1] += data

    def named(self, tag):
        """Attributes of the elements of a tag."""
        return [attributes for name, attributes in self.elements if name == tag]


def every_mark(name: str = "first") -> tuple[Chart, ...]:
    """Charts with every kind of mark."""
    f = np.geomspace(0.1, 400, 50)
    frequency = {"label": "frequency", "unit": "Hz", "log": True}
    with drawing([PANEL_IN, PANEL_IN]) as (above, below):
        above.set_axes(frequency, {"label": "size", "unit": "-", "log": True})
        above.span("band", 10, 20)
        above.area("spread", f, 0.5 / f, 2 / f, look=2)
        above.area("", f[:9], 1e-4 / f[:9], 2e-4 / f[:9], look=2)
        above.rule("line at 20 Hz", 20.0, dash=3)
        above.curve(name, f, 1 / f)
        above.curve("second", f, np.where(f < 5, np.nan, 1 / f**2), look=1)
        dots = {"line": False, "marker": "own", "look": 3}
        above.curve("dots", f[::5], 1 / f[::5], error=0.5 / f[::5], **dots)
        above.flags([2.0, 3.0], [0.5, 0.3], (name, "flag"))
        above.curve("only named", [], [], look=4)
        below.set_axes(frequency, {"label": "steps", "unit": "nm"})
        below.span("range", 0.1, 0.2, "y", look=5)
        below.rule("level", 0.3, "y")
        below.curve(name, f, 1 / f, step="steps-post")
    words = {"caption": "Lines, areas, rules and spans.", "alt": "Two curves that fall."}
    lines = Chart(key="lines", title=f"Lines of {name}", figure=above.figure, **words)
    values = np.arange(30.0).reshape(5, 6)
    values[0] = np.nan
    values[3, 2] = np.nan
    with drawing([PANEL_IN, PANEL_IN], columns=2) as panels:
        for panel, title in zip(panels, (name, "other"), strict=True):
            panel.set_axes(
                {"label": "error", "unit": "Hz"}, {"label": "gain", "unit": "-"}, title=title
            )
            gains = np.array([0.2, 0.4, 0.7, 1.0, 1.4])
            more = {"log": title == "other", "contours": True, "blank": "unstable"}
            panel.map(np.arange(6.0), gains, values, "ratio", "%", **more)
    words = {"caption": "Two maps.", "alt": "Values rise to the upper right."}
    maps = Chart(key="maps", title="Maps", figure=panels[0].figure, **words)
    turn = np.linspace(0, 2 * np.pi, 61)
    with drawing([1.0, square_in(1)]) as (bars, plane):
        bars.set_axes({"label": "share", "unit": "%", "low": 0}, {})
        lengths = {"first order": [1, 2, 3], "total": [2, np.nan, 4]}
        bars.bars(("a.b", name, "c"), lengths, {"first order": ([0.5, 1, 2], [2, 3, 4])})
        plane.set_axes({"label": "real"}, {"label": "imaginary"}, equal=True)
        plane.curve("", np.cos(turn), np.sin(turn), look=None)
    words = {"caption": "Bars and a plane.", "alt": "Three bars, one circle."}
    rest = Chart(key="rest", title="Bars and a plane", figure=bars.figure, **words)
    return lines, maps, rest


def whole_page(name: str = "first") -> Page:
    """A page with every kind of block."""
    table = Table(
        caption=f"Table of {name}",
        headings=("quantity", name, "b"),
        rows=(("Group",), ("x", "1.5", Cell(text="UNSTABLE", tone="bad")), (name, "yes", "no")),
        words=(2,),
    )
    wide = Table(
        caption="Wide",
        headings=("quantity", *(f"design {i}" for i in range(8))),
        rows=(("value", *(str(i) for i in range(8))),),
    )
    sections = {
        f"Summary of {name}": (
            f"Words of {name}. " * 20,
            Notice(text=f"{name} is bad", tone="bad"),
            Notice(text="note", tone="note"),
            table,
            wide,
        ),
        "Charts": every_mark(name),
        "Listing": ((name, f"a: 1\n\tb: {name}\n" + 200 * "x"),),
    }
    return Page(
        title=f"Page of {name}", subtitle=f"about {name}", sections=sections, digests={}, made=""
    )
