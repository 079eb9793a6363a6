"""Panels on a page of a server, whose curves follow new descriptions."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.report.charts.bokeh_panels import panel_columns, panel_figure, set_scales
from lbt_synth.report.charts.description import Curve, Panel, Rule
from lbt_synth.report.charts.scales import scale_ends
from lbt_synth.validation import FloatArray


class LivePanel:
    """A place for a panel, drawn again only where its marks are others."""

    def __init__(self, name: str) -> None:
        from bokeh.models import GridBox

        self.root = GridBox(name=name, sizing_mode="stretch_width")
        self._styles: object = None
        self._ends: object = None
        self._sources: dict[str, Any] = {}
        self._columns: dict[str, dict[str, FloatArray]] = {}

    def show(self, panel: Panel) -> None:
        """Show a panel of curves and rules."""
        columns, styles, ends = panel_columns(panel), _styles_of(panel), scale_ends(panel)
        if styles != self._styles or columns.keys() != self._columns.keys():
            self._sources = {}
            figure = panel_figure(panel, {}, {}, self._sources)
            figure.toolbar.active_drag = None  # a finger scrolls the page
            self.root.children = [(figure, 0, 0)]
        else:
            if ends != self._ends:
                set_scales(self.root.children[0][0], panel)
            for key, new in columns.items():
                if not _same_columns(new, self._columns[key]):
                    self._sources[key].data = new
        self._styles, self._ends, self._columns = styles, ends, columns


def _styles_of(panel: Panel) -> object:
    """Return how the marks of a panel look, and what its axes are."""
    curves = [
        (c.name, c.look, c.line, c.marker, c.filled, c.size, c.width, c.dash, c.hover)
        for c in panel.select(Curve)
    ]
    rules = {(rule.name, rule.axis, rule.dash) for rule in panel.select(Rule)}
    return panel.x.text, panel.y.text, curves, rules


def _same_columns(one: dict[str, FloatArray], other: dict[str, FloatArray]) -> bool:
    return one.keys() == other.keys() and all(
        np.array_equal(one[name], other[name], equal_nan=True) for name in one
    )
