"""Charts for the screen: Bokeh models as data that a page carries, with hover and zoom.

Only data leaves this module. The page embeds it with the script of the library itself,
and asks no network for anything.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from lbt_synth.report.charts.bokeh_panels import panel_figure
from lbt_synth.report.charts.description import Chart

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
