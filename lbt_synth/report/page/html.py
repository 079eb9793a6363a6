"""A page as one HTML file that needs nothing else."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from lbt_synth.report.charts.bokeh_charts import bokeh_script, embed_charts
from lbt_synth.report.charts.description import (
    Area,
    Bars,
    Chart,
    Curve,
    Map,
    Mark,
    Rule,
    Span,
    legend_entries,
)
from lbt_synth.report.charts.line_styles import GREY, PALE, SHADE, colour, dashes, marker_name
from lbt_synth.report.charts.matplotlib_charts import chart_svg
from lbt_synth.report.page.blocks import Listing, Notice, Page, Paragraph
from lbt_synth.storage.tables import Table

_KINDS = {
    Paragraph: "paragraph",
    Notice: "notice",
    Listing: "listing",
    Table: "table",
    Chart: "chart",
}
_COLUMNS = 6  # that fit a sheet of paper beside the first one of a table


def page_html(page: Page) -> bytes:
    """Return a page as one HTML file, UTF-8.

    Every text is escaped. Charts are there twice: as drawings, for paper and for browsers
    without JavaScript, and as data that the script in the page draws for the pointer.
    """
    from jinja2 import Environment, StrictUndefined

    here = files("lbt_synth.report.page")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals["kind_of"] = lambda block: _KINDS[type(block)]
    environment.globals["parts_of"] = lambda table: list(table.by_columns(_COLUMNS))
    drawn = embed_charts(page.charts)
    template = environment.from_string((here / "page.html.jinja").read_text(encoding="utf-8"))
    text = template.render(
        page=page,
        style=(here / "page.css").read_text(encoding="utf-8"),
        script=(here / "page.js").read_text(encoding="utf-8"),
        library=bokeh_script() if page.charts else "",
        data=_script_json(drawn.embedding),
        places=drawn.places,
        legends={
            chart.key: [
                (name, swatch(mark), " ".join(drawn.lines[chart.key].get(name, ())))
                for name, mark in legend_entries(chart.panels).items()
            ]
            for chart in page.charts
        },
        drawings={chart.key: chart_svg(chart) for chart in page.charts},
    )
    return text.encode()


def _script_json(value: Any) -> str:
    """Return JSON that cannot close the script element around it."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def swatch(mark: Mark) -> str:
    """Return what a legend shows beside a name, as an SVG element."""
    inside = ""
    if isinstance(mark, Curve | Rule):
        if isinstance(mark, Rule):
            strokes, shade, width = dashes(mark.dash), GREY, 1.2
        else:
            strokes = dashes(mark.look if mark.dash is None else mark.dash)
            shade, width = colour(mark.look), max(mark.width, 1.2)
        if isinstance(mark, Rule) or mark.line:
            pattern = " ".join(f"{2.0 * s:g}" for s in strokes)
            inside += f'<path d="M0 7H34" stroke="{shade}" stroke-width="{1.3 * width:g}" '
            inside += f'stroke-dasharray="{pattern or "none"}" fill="none"/>'
        if isinstance(mark, Curve) and mark.marker is not None:
            fill = shade if mark.filled else "#ffffff"
            path = _MARKER_PATHS[marker_name(mark.marker, mark.look)]
            inside += f'<path d="{path}" stroke="{shade}" stroke-width="1.5" fill="{fill}"/>'
    elif isinstance(mark, Map):
        inside = f'<path d="M4 1H30V13H4Z" fill="{PALE}"/>'
        inside += f'<path d="M6 13L18 1M14 13L26 1M22 13L30 5M4 7L10 1" stroke="{GREY}"/>'
    elif isinstance(mark, Area | Span | Bars):
        alpha = 1 if isinstance(mark, Bars) else SHADE
        inside = f'<path d="M4 1H30V13H4Z" fill="{colour(mark.look)}" fill-opacity="{alpha}"/>'
    return (
        '<svg class="swatch" viewBox="0 0 34 14" width="34" height="14" aria-hidden="true" '
        f'focusable="false">{inside}</svg>'
    )


_MARKER_PATHS = {
    "circle": "M13 7A4 4 0 1 0 21 7A4 4 0 1 0 13 7Z",
    "square": "M13 3H21V11H13Z",
    "triangle": "M17 2.5L21.5 11H12.5Z",
    "diamond": "M17 2L22 7L17 12L12 7Z",
    "cross": "M13 3L21 11M21 3L13 11",
    "plus": "M17 2V12M12 7H22",
}
