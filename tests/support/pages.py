"""A page with every kind of block and mark, and what tests read out of pages."""

from __future__ import annotations

from html.parser import HTMLParser

import numpy as np

from lbt_synth.report.charts.description import (
    Area,
    Axis,
    Bars,
    Chart,
    Curve,
    Flags,
    Map,
    Panel,
    Rule,
    Span,
)
from lbt_synth.report.page.blocks import Listing, Notice, Page, Paragraph, Section
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
    frequency = Axis(label="frequency", unit="Hz", log=True)
    lines = Chart(
        key="lines",
        title=f"Lines of {name}",
        caption="Lines, areas, rules and spans.",
        alt="Two curves that fall.",
        panels=(
            Panel(
                x=frequency,
                y=Axis(label="size", unit="-", log=True),
                marks=(
                    Span(name="band", low=10, high=20),
                    Area(name="spread", x=f, low=0.5 / f, high=2 / f, look=2),
                    Area(name="", x=f[:9], low=1e-4 / f[:9], high=2e-4 / f[:9], look=2, solid=True),
                    Rule(name="line at 20 Hz", at=20.0, dash=3),
                    Curve(name=name, x=f, y=1 / f, look=0),
                    Curve(name="second", x=f, y=np.where(f < 5, np.nan, 1 / f**2), look=1),
                    Curve(
                        name="dots",
                        x=f[::5],
                        y=1 / f[::5],
                        error=0.5 / f[::5],
                        line=False,
                        marker="own",
                        look=3,
                    ),
                    Flags(x=[2.0, 3.0], y=[0.5, 0.3], texts=(name, "flag")),
                    Curve(name="only named", x=[], y=[], look=4),
                ),
            ),
            Panel(
                x=frequency,
                y=Axis(label="steps", unit="nm"),
                marks=(
                    Span(name="range", axis="y", low=0.1, high=0.2, look=5),
                    Rule(name="level", at=0.3, axis="y"),
                    Curve(name=name, x=f, y=1 / f, step="after", look=0),
                ),
            ),
        ),
    )
    values = np.arange(30.0).reshape(5, 6)
    values[0] = np.nan
    values[3, 2] = np.nan
    maps = Chart(
        key="maps",
        title="Maps",
        caption="Two maps.",
        alt="Values rise to the upper right.",
        columns=2,
        panels=tuple(
            Panel(
                title=title,
                x=Axis(label="error", unit="Hz"),
                y=Axis(label="gain", unit="-"),
                marks=(
                    Map(
                        x=np.arange(6.0),
                        y=[0.2, 0.4, 0.7, 1.0, 1.4],
                        values=values,
                        low=1 if title == "other" else 0,
                        high=30,
                        label="ratio",
                        unit="%",
                        log=title == "other",
                        levels=(10, 20),
                        blank="unstable",
                    ),
                ),
            )
            for title in (name, "other")
        ),
    )
    turn = np.linspace(0, 2 * np.pi, 61)
    rest = Chart(
        key="rest",
        title="Bars and a plane",
        caption="Bars and a plane.",
        alt="Three bars, one circle.",
        panels=(
            Panel(
                x=Axis(label="share", unit="%", low=0),
                y=Axis(label="parameter"),
                categories=("a.b", name, "c"),
                marks=(
                    Bars(name="first order", values=[1, 2, 3], low=[0.5, 1, 2], high=[2, 3, 4]),
                    Bars(name="total", values=[2, np.nan, 4], look=1),
                ),
            ),
            Panel(
                x=Axis(label="real"),
                y=Axis(label="imaginary"),
                equal=True,
                marks=(Curve(name="", x=np.cos(turn), y=np.sin(turn), look=None),),
            ),
        ),
    )
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
    return Page(
        title=f"Page of {name}",
        subtitle=f"about {name}",
        sections=(
            Section(
                key="summary",
                title=f"Summary of {name}",
                blocks=(
                    Paragraph(text=f"Words of {name}. " * 20),
                    Notice(text=f"{name} is bad", tone="bad"),
                    Notice(text="note", tone="note"),
                    table,
                    wide,
                ),
            ),
            Section(key="charts", title="Charts", blocks=every_mark(name)),
            Section(
                key="listing",
                title="Listing",
                blocks=(Listing(caption=name, text=f"a: 1\n\tb: {name}\n" + 200 * "x"),),
            ),
        ),
    )


def many_panels(count, title="p", columns=2):
    """A chart of so many equal panels."""
    x = np.linspace(0, 1, 5)
    panel = Panel(
        title=title, x=Axis(label="x"), y=Axis(label="y"), marks=(Curve(name="a", x=x, y=x),)
    )
    return Chart(
        key="many", title="Many", caption="c", alt="a", panels=count * (panel,), columns=columns
    )
