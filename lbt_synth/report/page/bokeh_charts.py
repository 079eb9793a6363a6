"""Charts for the screen: Bokeh models as data that a page carries, with hover and zoom.

Only data leaves this module; the page embeds them with the script of the library itself,
and asks no network for anything.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.report.figures.map_cells import cell_edges
from lbt_synth.report.page.charts import (
    Area,
    Axis,
    Bars,
    Chart,
    Curve,
    Map,
    Mark,
    Panel,
    Rule,
    Span,
)
from lbt_synth.report.page.line_styles import GREY, PALE, colour, dashes, marker_name
from lbt_synth.report.page.matplotlib_charts import (
    bar_places,
    blank_cells,
    level_colour,
    levels_within,
)
from lbt_synth.report.page.scales import ends_of, log_tick_texts, log_ticks, shortened
from lbt_synth.validation import FloatArray

_HEIGHT = 300  # of a panel [px]
_MAP = 380  # of one with a scale of colours [px]
_SQUARE = 460  # width of one with equal scales, at most [px]
_BAR = 22  # of one bar [px]
_GLYPHS = {
    "circle": "circle",
    "square": "square",
    "triangle": "triangle",
    "diamond": "diamond",
    "cross": "x",
    "plus": "cross",
}
_FONT = "system-ui, sans-serif"
_IDENTIFIER = re.compile(r"p\d+")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Interactive:
    """Charts as data for BokehJS."""

    embedding: dict[str, Any]  # ``documents`` and ``items`` for ``Bokeh.embed.embed_items``
    # For each chart, the identifiers of the elements that its panels are drawn in
    places: dict[str, tuple[str, ...]]
    # For each chart and each name of its legend, the models that it stands for
    lines: dict[str, dict[str, tuple[str, ...]]]


def bokeh_script() -> str:
    """Return BokehJS, the core without widgets, to be set into a page."""
    from bokeh.resources import Resources

    (script,) = Resources(mode="inline", components=["bokeh"], minified=True).js_raw[:1]
    return str(script).replace("</script", "<\\/script")


def interactive(charts: Sequence[Chart]) -> Interactive:
    """Make charts into data for BokehJS.

    The same charts give the same data: models are numbered in their order.
    """
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
            figure = _figure(panel, shared, named)
            figures.append(figure)
            elements.append(f"{chart.key}_panel-{i + 1}")
            roots[figure.id] = elements[-1]
        places[chart.key] = tuple(elements)
        lines[chart.key] = {name: tuple(ids) for name, ids in named.items()}
    with document.models.freeze():  # what belongs to it is looked up once
        for figure in figures:
            document.add_root(figure)
    data = document.to_json(deferred=False)
    numbers: dict[str, str] = {}
    data = _renumbered(data, numbers)
    return Interactive(
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


def _renumbered(value: Any, numbers: dict[str, str]) -> Any:
    """Copy of a document with its models numbered from 1 in their order."""
    if isinstance(value, dict):
        out = {}
        for key, inner in value.items():
            if key == "id" and isinstance(inner, str) and _IDENTIFIER.fullmatch(inner):
                out[key] = numbers.setdefault(inner, f"p{len(numbers) + 1}")
            else:
                out[key] = _renumbered(inner, numbers)
        return out
    if isinstance(value, list | tuple):
        return [_renumbered(inner, numbers) for inner in value]
    return value


def _figure(panel: Panel, shared: dict[Any, Any], named: dict[str, list[str]]) -> Any:
    """Figure of a panel, and note whom each name stands for."""
    from bokeh.models import BoxZoomTool, PanTool, ResetTool, WheelZoomTool
    from bokeh.plotting import figure as new_figure

    zoom = BoxZoomTool(match_aspect=panel.equal)
    across, up = ends_of(panel)
    square: dict[str, Any] = {}
    if panel.equal:  # the borders are as wide as the toolbar and the labels are high
        (x0, x1), (y0, y1) = across, up
        square = {"aspect_ratio": abs((x1 - x0) / (y1 - y0)), "max_width": _SQUARE}
    figure = new_figure(
        x_axis_type="log" if panel.x.log else "linear",
        y_axis_type="log" if panel.y.log else "linear",
        x_range=shared.setdefault((panel.x.text, across), _range(across)),
        y_range=_range(up),
        height=None if panel.equal else _height(panel),
        sizing_mode="stretch_width",
        tools=[zoom, PanTool(), WheelZoomTool(), ResetTool()],
        toolbar_location="above",
        min_border_left=64,  # panels above each other are in line
        min_border_right=12,
        **square,
    )
    figure.toolbar.logo = None
    figure.toolbar.active_drag = zoom
    figure.toolbar.active_scroll = None
    figure.grid.grid_line_color = "#e0e0e0"
    figure.outline_line_color = None
    for axis, own, ends in ((figure.xaxis, panel.x, across), (figure.yaxis, panel.y, up)):
        _style_axis(axis, own, ends)
    for mark in panel.marks:
        for model in _draw(figure, panel, mark):
            name = mark.blank if isinstance(mark, Map) else mark.name
            if name and not isinstance(mark, Map):
                named.setdefault(name, []).append(model.id)
    _draw_bars(figure, panel, named)
    if panel.categories:
        figure.yaxis.ticker = list(range(len(panel.categories)))
        figure.yaxis.major_label_overrides = {
            i: shortened(name, 24) for i, name in enumerate(panel.categories)
        }
        figure.yaxis.axis_label = None
        figure.ygrid.grid_line_color = None
    _hover_curves(figure, panel)
    return figure


def _range(ends: tuple[float, float]) -> Any:
    from bokeh.models import Range1d

    return Range1d(start=ends[0], end=ends[1])


def _height(panel: Panel) -> int:
    if panel.categories:
        return 90 + _BAR * len(panel.categories) * max(1, len(panel.of(Bars)))
    if panel.of(Map):
        return _MAP
    if panel.height_in is not None:
        return int(60 + 115 * panel.height_in)
    return _HEIGHT


def _style_axis(axis: Any, own: Axis, ends: tuple[float, float]) -> None:
    from bokeh.models import PlainText

    axis.axis_label = PlainText(text=own.text)
    axis.axis_label_text_font = _FONT
    axis.axis_label_text_font_size = "13px"
    axis.axis_label_text_font_style = "normal"
    axis.axis_label_text_color = "#222222"
    axis.major_label_text_font = _FONT
    axis.major_label_text_font_size = "12px"
    axis.major_label_text_color = "#222222"
    axis.axis_line_color = "#808080"
    axis.minor_tick_line_color = None
    if own.log:
        from bokeh.models import FixedTicker

        # those of the whole scale, and finer ones for who zooms in
        fine = [t for t in _fine_ticks(ends) if t not in log_ticks(*ends)]
        ticks = log_ticks(*ends)
        axis.ticker = FixedTicker(ticks=ticks, minor_ticks=fine)
        axis.major_label_overrides = dict(zip(ticks, log_tick_texts(ticks), strict=True))


def _fine_ticks(ends: tuple[float, float]) -> list[float]:
    low, high = (int(np.floor(np.log10(end))) for end in ends)
    return [f * 10.0**n for n in range(low, high + 1) for f in range(1, 10)]


def _draw(figure: Any, panel: Panel, mark: Mark) -> list[Any]:
    """Draw a mark, and return the models that a legend hides with it."""
    from bokeh.models import BoxAnnotation
    from bokeh.models import Span as Line

    if isinstance(mark, Curve):
        return _draw_curve(figure, panel, mark)
    if isinstance(mark, Area):
        return [figure.varea(mark.x, mark.low, mark.high, color=colour(mark.look), alpha=0.25)]
    if isinstance(mark, Rule):
        strokes = [round(3 * s) for s in dashes(mark.dash)]
        line = Line(
            location=mark.at,
            dimension="height" if mark.axis == "x" else "width",
            line_color=GREY,
            line_width=1.2,
            line_dash=strokes,
        )
        figure.add_layout(line)
        return [line]
    if isinstance(mark, Span):
        ends = {"left": mark.low, "right": mark.high}
        if mark.axis == "y":
            ends = {"bottom": mark.low, "top": mark.high}
        box = BoxAnnotation(fill_color=colour(mark.look), fill_alpha=0.25, line_color=None, **ends)
        figure.add_layout(box)
        return [box]
    if isinstance(mark, Map):
        _draw_map(figure, panel, mark)
    return []


def _draw_curve(figure: Any, panel: Panel, curve: Curve) -> list[Any]:
    if not curve.x.size:
        return []
    x = np.where(curve.x > 0, curve.x, np.nan) if panel.x.log else np.array(curve.x)
    y = np.where(curve.y > 0, curve.y, np.nan) if panel.y.log else np.array(curve.y)
    shade, drawn = colour(curve.look), []
    if curve.line:
        strokes = [max(1, round(2.4 * s)) for s in dashes(curve.look)] if curve.dashed else []
        style = {"line_color": shade, "line_width": 1.25 * curve.width, "line_dash": strokes}
        if curve.step:
            drawn.append(figure.step(x, y, mode="after", **style))
        else:
            drawn.append(figure.line(x, y, **style))
    if curve.marker is not None:
        name = marker_name(curve.marker, curve.look)
        drawn.append(
            figure.scatter(
                x,
                y,
                marker=_GLYPHS[name],
                size=1.6 * curve.size,
                line_color=shade,
                fill_color=shade if curve.filled else None,
                line_width=1.5,
            )
        )
    return drawn


def _hover_curves(figure: Any, panel: Panel) -> None:
    """Show the values of all curves of the same abscissae in one box."""
    from bokeh.models import ColumnDataSource, HoverTool

    groups: list[list[Curve]] = []
    for curve in panel.of(Curve):
        if not curve.x.size or not curve.hover:
            continue
        for group in groups:
            if curve.line and group[0].line and np.array_equal(group[0].x, curve.x):
                group.append(curve)
                break
        else:
            groups.append([curve])
    for group in groups:
        joined = group[0].line
        columns: dict[str, FloatArray] = {"x": np.array(group[0].x)}
        columns |= {f"y{i}": np.array(curve.y) for i, curve in enumerate(group)}
        tips = [(panel.x.label, _value("x", panel.x.unit))]
        tips += [
            (curve.name or panel.y.label, _value(f"y{i}", panel.y.unit))
            for i, curve in enumerate(group)
        ]
        # what the box follows: the finite mean, or the points themselves
        heights = np.array([curve.y for curve in group])
        columns["at"] = _middle(heights, log=panel.y.log)
        source = ColumnDataSource(columns)
        follower = (
            figure.line("x", "at", source=source, line_alpha=0)
            if joined
            else figure.scatter("x", "at", source=source, size=12, line_alpha=0, fill_alpha=0)
        )
        figure.add_tools(
            HoverTool(
                renderers=[follower],
                tooltips=tips,
                formatters={f"@{name}": "printf" for name in columns},
                mode="vline" if joined else "mouse",
                line_policy="nearest",
                visible=False,
            )
        )


def _middle(heights: FloatArray, *, log: bool) -> FloatArray:
    """Middle of several curves at each abscissa; nan where none has a value."""
    shown = np.where(heights > 0, heights, np.nan) if log else heights
    known = np.isfinite(shown)
    filled = np.where(known, np.log(np.where(known, shown, 1.0)) if log else shown, 0.0)
    count = known.sum(axis=0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.exp(mean) if log else mean, np.nan)


def _value(column: str, unit: str) -> str:
    return f"@{column}{{%.4g}}" + (f" {unit}" if unit and unit != "-" else "")


def _draw_bars(figure: Any, panel: Panel, named: dict[str, list[str]]) -> None:
    from bokeh.models import HoverTool

    series = panel.of(Bars)
    for bars, (offset, height) in zip(series, bar_places(len(series)), strict=True):
        places = np.arange(len(panel.categories)) + offset
        drawn = np.isfinite(bars.values)
        source = {
            "y": places[drawn],
            "right": bars.values[drawn],
            "category": [name for name, kept in zip(panel.categories, drawn, strict=True) if kept],
        }
        if bars.low is not None and bars.high is not None:
            source |= {"low": bars.low[drawn], "high": bars.high[drawn]}
        box = figure.hbar(
            y="y", right="right", height=height, color=colour(bars.look), source=source
        )
        models = [box]
        tips = [
            (panel.y.label or "bar", "@category"),
            (bars.name or panel.x.label, _value("right", panel.x.unit)),
        ]
        if "low" in source:
            models.append(
                figure.segment(
                    x0="low",
                    x1="high",
                    y0="y",
                    y1="y",
                    source=box.data_source,
                    line_color="black",
                    line_width=1.5,
                )
            )
            tips.append(("interval", f"@low{{%.4g}} to {_value('high', panel.x.unit)}"))
        figure.add_tools(
            HoverTool(
                renderers=[box],
                tooltips=tips,
                formatters={f"@{name}": "printf" for name in ("right", "low", "high")},
                visible=False,
            )
        )
        if bars.name:
            named.setdefault(bars.name, []).extend(model.id for model in models)


def _draw_map(figure: Any, panel: Panel, found: Map) -> None:
    from bokeh.models import ColorBar, HoverTool, LinearColorMapper, PlainText

    figure.grid.grid_line_color = None
    x, y = cell_edges(found.x), cell_edges(found.y)
    known = np.isfinite(found.values)
    rows, columns = np.nonzero(known)
    mapper = LinearColorMapper(palette="Viridis256", low=found.low, high=found.high)
    cells = figure.quad(
        left="left",
        right="right",
        bottom="bottom",
        top="top",
        fill_color={"field": "value", "transform": mapper},
        line_color={"field": "value", "transform": mapper},  # no seams between cells
        source={
            "left": x[columns],
            "right": x[columns + 1],
            "bottom": y[rows],
            "top": y[rows + 1],
            "value": found.values[known],
            "x": found.x[columns],
            "y": found.y[rows],
        },
    )
    blank = np.array(list(blank_cells(~known, x, y))).reshape(-1, 4)
    figure.quad(
        left=blank[:, 0],
        right=blank[:, 1],
        bottom=blank[:, 2],
        top=blank[:, 3],
        fill_color=PALE,
        line_color=None,
        hatch_pattern="right_diagonal_line",
        hatch_color=GREY,
        hatch_alpha=0.5,
        hatch_weight=0.8,
        hatch_scale=10,
    )
    _draw_levels(figure, found)
    figure.add_layout(
        ColorBar(
            color_mapper=mapper,
            height=10,
            title=PlainText(text=found.text),
            padding=6,
            title_text_font=_FONT,
            title_text_font_size="12px",
            title_text_font_style="normal",
            major_label_text_font=_FONT,
            major_label_text_font_size="12px",
        ),
        "below",
    )
    figure.add_tools(
        HoverTool(
            renderers=[cells],
            tooltips=[
                (panel.x.label, _value("x", panel.x.unit)),
                (panel.y.label, _value("y", panel.y.unit)),
                (found.label, _value("value", found.unit)),
            ],
            formatters={"@x": "printf", "@y": "printf", "@value": "printf"},
            visible=False,
        )
    )


def _draw_levels(figure: Any, found: Map) -> None:
    from contourpy import contour_generator

    levels = levels_within(found)
    if not levels:
        return
    generator = contour_generator(found.x, found.y, np.ma.masked_invalid(found.values))
    paths, shades = [], []
    for level in levels:
        for path in generator.lines(level):
            paths.append(path)
            shades.append(level_colour(found, level))
    figure.multi_line(
        [path[:, 0] for path in paths],
        [path[:, 1] for path in paths],
        line_color=shades,
        line_width=1.0,
    )
