"""A page as one HTML file that needs nothing else."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from lbt_synth.report.charts.bokeh_charts import bokeh_script, embed_charts
from lbt_synth.report.charts.description import PALE, SHADE, colour, dashes, marker_name
from lbt_synth.report.charts.matplotlib_charts import chart_svg
from lbt_synth.report.charts.scales import legend_entries
from lbt_synth.report.number_text import print_text, unbroken_text
from lbt_synth.report.page.blocks import Page
from lbt_synth.report.provenance import creator_name

# in a box of 34 times 14, around its middle
_MARKER_PATHS = {
    "circle": "M13 7A4 4 0 1 0 21 7A4 4 0 1 0 13 7Z",
    "square": "M13 3H21V11H13Z",
    "triangle": "M17 2.5L21.5 11H12.5Z",
    "diamond": "M17 2L22 7L17 12L12 7Z",
    "cross": "M13 3L21 11M21 3L13 11",
    "plus": "M17 2V12M12 7H22",
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
    environment.globals |= {
        "kind_of": lambda block: type(block).__name__.lower(),
        "parts_of": lambda table: list(table.by_columns(_COLUMNS)),
        "colour": colour,
        "strokes": lambda look: " ".join(f"{2 * stroke:g}" for stroke in dashes(look)) or "none",
        "marker_path": lambda curve: _MARKER_PATHS[marker_name(curve.marker, curve.look)],
        "printed": print_text,
        "unbroken": unbroken_text,
        "shade": SHADE,
        "pale": PALE,
    }
    embedding, lines = embed_charts(page.charts)
    template = environment.from_string((here / "page.html.jinja").read_text(encoding="utf-8"))
    text = template.render(
        page=page,
        creator=creator_name(),
        style=(here / "page.css").read_text(encoding="utf-8"),
        script=(here / "page.js").read_text(encoding="utf-8"),
        library=bokeh_script() if page.charts else "",
        data=_script_json(embedding),
        legends={
            chart.key: [
                (name, mark, " ".join(lines[chart.key].get(name, ())))
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
