"""Charts for the screen: Bokeh models as data that a page carries, with hover and zoom.

Only data leaves this module. The page embeds it with the script of the library itself,
and asks no network for anything.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.report.charts.bokeh_panels import panel_columns, panel_figure, set_scales
from lbt_synth.report.charts.description import Chart, Curve, Panel, Rule
from lbt_synth.report.charts.scales import scale_ends
from lbt_synth.validation import FloatArray

_IDENTIFIER = re.compile(r"p\d+")


def bokeh_script() -> str:
    """Return BokehJS, the core without widgets, to be set into a page."""
    from bokeh.resources import Resources

    (script,) = Resources(mode="inline", components=["bokeh"], minified=True).js_raw[:1]
    return str(script).replace("</script", "<\\/script")


def embed_charts(
    charts: Sequence[Chart],
) -> tuple[dict[str, Any], dict[str, dict[str, list[str]]]]:
    """Return charts as data for BokehJS; the same charts give the same data.

    The data have ``documents`` and ``items`` for ``Bokeh.embed.embed_items``; panel i of a chart is
    drawn in the element ``key_panel-i``, counted from 1. Beside them, for each chart and each name
    of its legend, the models that it hides or shows.
    """
    from bokeh.document import Document

    document = Document()
    elements: dict[Any, str] = {}  # of each figure, the place that it is drawn in
    lines: dict[str, dict[str, list[str]]] = {}
    for chart in charts:
        named, shared = lines.setdefault(chart.key, {}), dict[Any, Any]()
        for number, panel in enumerate(chart.panels, start=1):
            elements[panel_figure(panel, shared, named)] = f"{chart.key}_panel-{number}"
    with document.models.freeze():  # its models are looked up once
        for figure in elements:
            document.add_root(figure)
    numbers: dict[str, str] = {}
    data = _renumber(document.to_json(deferred=False), numbers)
    roots = {numbers[figure.id]: element for figure, element in elements.items()}
    items = [{"docid": "page", "roots": roots, "root_ids": list(roots)}]
    for named in lines.values():
        for ids in named.values():
            ids[:] = [numbers[i] for i in ids]
    return {"documents": {"page": data}, "items": items}, lines


def _renumber(value: Any, numbers: dict[str, str]) -> Any:
    """Copy a document with its models numbered from 1 in their order."""
    if isinstance(value, dict):
        out = {}
        for key, inner in value.items():
            if key == "id" and isinstance(inner, str) and _IDENTIFIER.fullmatch(inner):
                out[key] = numbers.setdefault(inner, f"p{len(numbers) + 1}")
            else:
                out[key] = _renumber(inner, numbers)
        return out
    if isinstance(value, list | tuple):
        return [_renumber(inner, numbers) for inner in value]
    return value


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
