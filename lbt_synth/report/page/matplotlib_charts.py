"""Charts for paper: drawn by matplotlib, as SVG or on the sheet of a PDF.

The layout is in inches and fixed, so that the same chart is always the same drawing.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import numpy as np

from lbt_synth.report.figures.style import house_style
from lbt_synth.report.line_styles import GREY, PALE, colour, dashes, marker_name
from lbt_synth.report.map_cells import blank_cells, cell_edges, draw_cells
from lbt_synth.report.page.charts import (
    Area,
    Bars,
    Chart,
    Curve,
    Map,
    Mark,
    Panel,
    Rule,
    Span,
    legend_entries,
)
from lbt_synth.report.page.scales import bar_places, log_tick_texts, log_ticks, scale_ends, shorten

WIDTH_IN = 7.0
_PANEL_IN, _BAR_IN = 2.1, 0.24  # height of a panel, and of one bar
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.62, 0.12, 0.42, 0.08
_TITLE, _LEGEND_ROW, _SCALE = 0.22, 0.2, 0.62
_LETTER = 0.068  # width of a letter at 8 points [inch], generously
_BOLD_LETTER = 0.08  # of a bold one
_LONGEST = 60
_HIGHEST = 7.5  # of a panel with bars [inch], so that it fits a sheet
_MARKERS = {
    "circle": "o",
    "square": "s",
    "triangle": "^",
    "diamond": "D",
    "cross": "x",
    "plus": "+",
}
_SVG, _LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"


@contextmanager
def chart_style() -> Iterator[None]:
    """Set the style of charts for the time of the block; names are never read as mathematics."""
    import matplotlib as mpl

    with house_style(), mpl.rc_context(_STYLE), warnings.catch_warnings():
        # a name in a script that the font does not have stays a name
        warnings.filterwarnings("ignore", message=r"Glyph .* missing")
        yield


_STYLE: dict[str, Any] = {
    "font.size": 8.5,
    "axes.labelsize": 8.5,
    "axes.titlesize": 8.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.parse_math": False,
    "axes.formatter.useoffset": False,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}


def chart_svg(chart: Chart) -> str:
    """Return a chart as an SVG element to be set into a page.

    Its identifiers begin with the chart's key, its size follows the place that it gets.
    """
    from matplotlib.figure import Figure

    buffer = io.BytesIO()
    with chart_style():
        figure = Figure(figsize=(WIDTH_IN, chart_height(chart)))
        draw_chart(figure, chart, left=0, top=chart_height(chart))
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    root = ElementTree.fromstring(buffer.getvalue())
    for child in root.findall(f"{{{_SVG}}}metadata"):
        root.remove(child)
    for name in ("width", "height"):
        root.attrib.pop(name, None)
    root.attrib |= {"role": "img", "aria-label": chart.alt}
    seen: set[str] = set()
    for element in root.iter():
        if element.attrib.get("id") in seen:  # the same path, defined again
            del element.attrib["id"]
        for name, value in element.attrib.items():
            if name == "id":
                seen.add(value)
                element.attrib[name] = f"{chart.key}_{value}"
            elif name == f"{{{_LINK}}}href" and value.startswith("#"):
                element.attrib[name] = f"#{chart.key}_{value[1:]}"
            elif "url(#" in value and name != "aria-label":
                element.attrib[name] = value.replace("url(#", f"url(#{chart.key}_")
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    return ElementTree.tostring(root, encoding="unicode")


def chart_height(chart: Chart, width: float = WIDTH_IN) -> float:
    """Height of a chart [inch] at a width."""
    scale = _SCALE if chart.maps else 0.0
    return _legend_height(chart, width) + sum(_row_heights(chart, width)) + scale


def draw_chart(
    figure: Any, chart: Chart, *, left: float, top: float, width: float = WIDTH_IN
) -> None:
    """Draw a chart on a figure, its upper left corner at a place [inch] from the lower left one."""
    sheet_width, sheet_height = figure.get_size_inches()

    def axes_at(x: float, y: float, w: float, h: float) -> Any:
        return figure.add_axes(
            (x / sheet_width, y / sheet_height, w / sheet_width, h / sheet_height)
        )

    _draw_legend(figure, chart, left, top, width)
    y = top - _legend_height(chart, width)
    image = None
    margin, cell = _left_margin(chart), width / chart.columns
    for row, height in zip(_rows(chart), _row_heights(chart, width), strict=True):
        y -= height
        titled = any(panel.title for panel in row)
        for i, panel in enumerate(row):
            axes = axes_at(
                left + i * cell + margin,
                y + _BOTTOM,
                cell - margin - _RIGHT,
                height - _BOTTOM - _TOP - titled * _TITLE,
            )
            room = int((cell - margin - _RIGHT) / _BOLD_LETTER)
            image = _draw_panel(axes, panel, room) or image
    if image is not None:
        where = axes_at(left + width * 0.25, y - _SCALE + 0.44, width * 0.5, 0.11)
        bar = figure.colorbar(image, cax=where, orientation="horizontal")
        bar.set_label(chart.maps[0].text)
        bar.outline.set_visible(False)


def _rows(chart: Chart) -> list[Sequence[Panel]]:
    return [chart.panels[i : i + chart.columns] for i in range(0, len(chart.panels), chart.columns)]


def _row_heights(chart: Chart, width: float) -> list[float]:
    """Heights of the rows [inch], with labels and titles."""
    inside = width / chart.columns - _left_margin(chart) - _RIGHT

    def own(panel: Panel) -> float:
        if panel.height_in is not None:
            return panel.height_in
        if panel.equal:
            (x0, x1), (y0, y1) = scale_ends(panel)
            return min(inside * abs((y1 - y0) / (x1 - x0)), 5.0)
        if panel.categories:
            bars = len(panel.categories) * max(1, len(panel.select(Bars)))
            return min(max(0.8, _BAR_IN * bars + 0.2), _HIGHEST)
        return _PANEL_IN

    return [
        max(map(own, row)) + _BOTTOM + _TOP + _TITLE * any(panel.title for panel in row)
        for row in _rows(chart)
    ]


def _left_margin(chart: Chart) -> float:
    longest = max(
        (len(shorten(name, 36)) for panel in chart.panels for name in panel.categories), default=0
    )
    return _LEFT if longest == 0 else 0.25 + _LETTER * longest


def _legend_columns(names: Sequence[str], width: float) -> int:
    widest = 0.55 + _LETTER * max(len(shorten(name, _LONGEST)) for name in names)
    return int(max(1, min(len(names), (width - 0.2) // widest)))


def _legend_height(chart: Chart, width: float) -> float:
    names = list(legend_entries(chart.panels))
    if not names:
        return 0.0
    return 0.1 + _LEGEND_ROW * -(-len(names) // _legend_columns(names, width))


def _draw_legend(figure: Any, chart: Chart, left: float, top: float, width: float) -> None:
    entries = legend_entries(chart.panels)
    if not entries:
        return
    sheet = figure.get_size_inches()
    # a leading underscore would leave a name out
    names = [f" {name}" if name.startswith("_") else name for name in entries]
    figure.legend(
        [_legend_handle(mark) for mark in entries.values()],
        [shorten(name, _LONGEST) for name in names],
        loc="upper center",
        bbox_to_anchor=((left + width / 2) / sheet[0], top / sheet[1]),
        ncols=_legend_columns(names, width),
        borderaxespad=0.0,
        handlelength=3.2,
    )


def _legend_handle(mark: Mark) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(mark, Curve):
        return Line2D([], [], **_curve_style(mark))
    if isinstance(mark, Rule):
        return Line2D([], [], **_rule_style(mark))
    if isinstance(mark, Map):
        return Patch(facecolor=PALE, edgecolor="0.55", hatch="////", linewidth=0)
    solid = isinstance(mark, Bars)
    return Patch(facecolor=colour(mark.look), alpha=1.0 if solid else 0.25, linewidth=0)


def _curve_style(curve: Curve) -> dict[str, Any]:
    strokes = dashes(curve.look) if curve.dashed else ()
    style: dict[str, Any] = {
        "color": colour(curve.look),
        "linewidth": curve.width,
        "linestyle": ((0, strokes) if strokes else "-") if curve.line else "none",
    }
    if curve.marker is not None:
        style |= {
            "marker": _MARKERS[marker_name(curve.marker, curve.look)],
            "markersize": curve.size,
            "markerfacecolor": colour(curve.look) if curve.filled else "none",
            "markeredgewidth": 0.4 if curve.filled and curve.line else 1.2,
        }
    return style


def _rule_style(rule: Rule) -> dict[str, Any]:
    strokes = dashes(rule.dash)
    return {"color": GREY, "linewidth": 1.0, "linestyle": (0, strokes) if strokes else "-"}


def _draw_panel(axes: Any, panel: Panel, letters: int) -> Any:
    """Draw a panel with a title of at most so many letters, and return its map if it has one."""
    image = None
    axes.set_title(shorten(panel.title, letters), loc="left", fontweight="bold")
    for mark in panel.marks:
        if isinstance(mark, Curve):
            if mark.x.size:
                style = _curve_style(mark) | ({"drawstyle": "steps-post"} if mark.step else {})
                axes.plot(mark.x, mark.y, clip_on=True, **style)
        elif isinstance(mark, Area):
            axes.fill_between(
                mark.x, mark.low, mark.high, color=colour(mark.look), alpha=0.25, linewidth=0
            )
        elif isinstance(mark, Rule):
            (axes.axvline if mark.axis == "x" else axes.axhline)(mark.at, **_rule_style(mark))
        elif isinstance(mark, Span):
            (axes.axvspan if mark.axis == "x" else axes.axhspan)(
                mark.low, mark.high, color=colour(mark.look), alpha=0.25, linewidth=0
            )
        elif isinstance(mark, Map):
            image = _draw_map(axes, mark)
    _draw_bars(axes, panel)
    _set_scales(axes, panel)
    return image


def _set_scales(axes: Any, panel: Panel) -> None:
    for end, own, scale in (("x", panel.x, axes.xaxis), ("y", panel.y, axes.yaxis)):
        low, high = scale_ends(panel)[end == "y"]
        if own.log:
            getattr(axes, f"set_{end}scale")("log")
            ticks = log_ticks(low, high)
            scale.set_ticks(ticks, log_tick_texts(ticks))
            scale.set_ticks([], minor=True)
        getattr(axes, f"set_{end}lim")(low, high)
        getattr(axes, f"set_{end}label")(own.text)
    if panel.categories:
        axes.set_yticks(
            range(len(panel.categories)), [shorten(name, 36) for name in panel.categories]
        )
        axes.set_ylabel("")
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
    if panel.equal:
        axes.set_aspect("equal")


def _draw_bars(axes: Any, panel: Panel) -> None:
    series = panel.select(Bars)
    for bars, (offset, height) in zip(series, bar_places(len(series)), strict=True):
        places = np.arange(len(panel.categories)) + offset
        drawn = np.isfinite(bars.values)
        axes.barh(places[drawn], bars.values[drawn], height=height, color=colour(bars.look))
        if bars.low is not None and bars.high is not None:
            axes.hlines(places, bars.low, bars.high, color="black", linewidth=1.0)


def _draw_map(axes: Any, found: Map) -> Any:
    image = draw_cells(
        axes,
        found.x,
        found.y,
        found.values,
        low=found.low,
        high=found.high,
        levels=found.levels,
    )
    x, y = cell_edges(found.x), cell_edges(found.y)
    for left, right, low, high in blank_cells(np.isnan(found.values), x, y):
        axes.fill_between(
            [left, right], low, high, facecolor=PALE, edgecolor="0.55", hatch="////", linewidth=0
        )
    return image
