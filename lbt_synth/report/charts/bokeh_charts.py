"""Charts for the screen: Bokeh models as data that a page carries, with hover and zoom.

Only data leaves this module. The page embeds it with the script of the library itself,
and asks no network for anything.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lbt_synth.report.charts.bokeh_panels import panel_figure
from lbt_synth.report.charts.description import Chart

_IDENTIFIER = re.compile(r"p\d+")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EmbeddedCharts:
    """Charts as data for BokehJS."""

    embedding: dict[str, Any]  # ``documents`` and ``items`` for ``Bokeh.embed.embed_items``
    # For each chart, the identifiers of the elements that its panels are drawn in
    places: dict[str, tuple[str, ...]]
    # For each chart and each name of its legend, the models that it hides or shows
    lines: dict[str, dict[str, tuple[str, ...]]]


def bokeh_script() -> str:
    """Return BokehJS, the core without widgets, to be set into a page."""
    from bokeh.resources import Resources

    (script,) = Resources(mode="inline", components=["bokeh"], minified=True).js_raw[:1]
    return str(script).replace("</script", "<\\/script")


def embed_charts(charts: Sequence[Chart]) -> EmbeddedCharts:
    """Turn charts into data for BokehJS; the same charts give the same data."""
    from bokeh.document import Document

    document = Document()
    roots: dict[str, str] = {}
    places: dict[str, tuple[str, ...]] = {}
    lines: dict[str, dict[str, tuple[str, ...]]] = {}
    figures = []
    for chart in charts:
        named: dict[str, list[str]] = {}
        shared: dict[Any, Any] = {}
        elements = []
        for i, panel in enumerate(chart.panels):
            figure = panel_figure(panel, shared, named)
            figures.append(figure)
            elements.append(f"{chart.key}_panel-{i + 1}")
            roots[figure.id] = elements[-1]
        places[chart.key] = tuple(elements)
        lines[chart.key] = {name: tuple(ids) for name, ids in named.items()}
    with document.models.freeze():  # its models are looked up once
        for figure in figures:
            document.add_root(figure)
    data = document.to_json(deferred=False)
    numbers: dict[str, str] = {}
    data = _renumber(data, numbers)
    return EmbeddedCharts(
        embedding={
            "documents": {"page": data},
            "items": [
                {
                    "docid": "page",
                    "roots": {numbers[i]: element for i, element in roots.items()},
                    "root_ids": [numbers[i] for i in roots],
                }
            ],
        },
        places=places,
        lines={
            key: {name: tuple(numbers[i] for i in ids) for name, ids in own.items()}
            for key, own in lines.items()
        },
    )


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
