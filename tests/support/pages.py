"""A page with every kind of block and mark, and what tests read out of pages."""

from html.parser import HTMLParser

import numpy as np

from lbt_synth.report import draw
from lbt_synth.report.page.html import Chart, Notice, Page
from lbt_synth.storage.tables import Cell, Table

HOSTILE = "</script><script>alert(1)</script><b>&\"'$x$ $$y$$ _z"
VOID = {"meta", "br", "hr", "img", "input", "link"}


class Reader(HTMLParser):
    """Elements of a page in their order, with what is inside; refuses what is not well formed."""

    def __init__(self, text):
        super().__init__()
        self.stack, self.elements, self.texts = [], [], {}
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
        return [attributes for name, attributes in self.elements if name == tag]


def every_mark(name="first"):
    """Charts with every kind of mark."""
    f, frequency = np.geomspace(0.1, 400, 50), ("frequency", "Hz")
    with draw.drawing([draw.PANEL_IN, draw.PANEL_IN]) as (above, below):
        draw.name_axes(above, frequency, ("size", "-"), xscale="log", yscale="log")
        above.axvspan(10, 20, label="band", color="0.3", **draw.SHADE)
        above.fill_between(f, 0.5 / f, 2 / f, label="spread", **draw.SHADE)
        above.axvline(20.0, label="line at 20 Hz", linestyle=":", **draw.GUIDE)
        above.plot(f, 1 / f, label=name, **draw.line_style(0))
        above.plot(f, np.where(f < 5, np.nan, 1 / f**2), label="second", **draw.line_style(1))
        above.vlines(f[::5], 0.5 / f[::5], 1.5 / f[::5])
        above.plot(f[::5], 1 / f[::5], label="dots", **draw.dot_style(3))
        above.plot([], [], label="only named", **draw.line_style(4))
        _, factor = draw.name_axes(below, frequency, ("steps", "nm"), xscale="log")
        below.axhline(0.3, **draw.GUIDE)
        below.plot(f, factor / f, label=name, **draw.line_style(0, drawstyle="steps-post"))
    words = {"caption": "Lines, areas, rules and spans.", "alt": "Two curves that fall."}
    lines = Chart(key="lines", title=f"Lines of {name}", figure=above.figure, **words)
    values = np.arange(30.0).reshape(5, 6)
    values[0] = np.nan
    values[3, 2] = np.nan
    with draw.drawing([draw.PANEL_IN, draw.PANEL_IN], columns=2) as panels:
        for panel, title in zip(panels, (name, "other"), strict=True):
            draw.name_axes(panel, ("error", "Hz"), ("gain", "-"), title)
        grid = np.arange(6.0), np.array([0.2, 0.4, 0.7, 1.0, 1.4]), values
        draw.draw_map(panels, [grid, grid], "ratio [%]", blank="unstable")
    words = {"caption": "Two maps.", "alt": "Values rise to the upper right."}
    return lines, Chart(key="maps", title="Maps", figure=panels[0].figure, **words)


def whole_page(name="first"):
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
