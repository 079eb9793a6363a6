"""One panel of a chart for the screen: its axes, curves, areas and lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.report.line_styles import GREY, colour, dashes, marker_name
from lbt_synth.report.page.bokeh_bars_and_maps import FONT, draw_bars, draw_map
from lbt_synth.report.page.bokeh_hover import hover_curves
from lbt_synth.report.page.charts import Area, Axis, Bars, Curve, Map, Mark, Panel, Rule, Span
from lbt_synth.report.page.scales import log_tick_texts, log_ticks, scale_ends, shorten

_HEIGHT = 300  # of a panel [px]
_MAP_HEIGHT = 380  # of one with a colour scale [px]
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


def panel_figure(panel: Panel, shared: dict[Any, Any], named: dict[str, list[str]]) -> Any:
    """Return the figure of a panel.

    Equal scales are taken from ``shared``; the models of each name are added to ``named``.
    """
    from bokeh.models import BoxZoomTool, PanTool, ResetTool, WheelZoomTool
    from bokeh.plotting import figure as new_figure

    zoom = BoxZoomTool(match_aspect=panel.equal)
    across, up = scale_ends(panel)
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
        if isinstance(mark, Map):
            draw_map(figure, panel, mark)
            continue
        for model in _draw(figure, panel, mark):
            if mark.name:
                named.setdefault(mark.name, []).append(model.id)
    draw_bars(figure, panel, named)
    if panel.categories:
        figure.yaxis.ticker = list(range(len(panel.categories)))
        figure.yaxis.major_label_overrides = {
            i: shorten(name, 24) for i, name in enumerate(panel.categories)
        }
        figure.yaxis.axis_label = None
        figure.ygrid.grid_line_color = None
    hover_curves(figure, panel)
    return figure


def _range(ends: tuple[float, float]) -> Any:
    from bokeh.models import Range1d

    return Range1d(start=ends[0], end=ends[1])


def _height(panel: Panel) -> int:
    if panel.categories:
        return 90 + _BAR * len(panel.categories) * max(1, len(panel.select(Bars)))
    if panel.select(Map):
        return _MAP_HEIGHT
    if panel.height_in is not None:
        return int(60 + 115 * panel.height_in)
    return _HEIGHT


def _style_axis(axis: Any, own: Axis, ends: tuple[float, float]) -> None:
    from bokeh.models import PlainText

    axis.axis_label = PlainText(text=own.text)
    axis.axis_label_text_font = FONT
    axis.axis_label_text_font_size = "13px"
    axis.axis_label_text_font_style = "normal"
    axis.axis_label_text_color = "#222222"
    axis.major_label_text_font = FONT
    axis.major_label_text_font_size = "12px"
    axis.major_label_text_color = "#222222"
    axis.axis_line_color = "#808080"
    axis.minor_tick_line_color = None
    if own.log:
        from bokeh.models import FixedTicker

        ticks = log_ticks(*ends)
        # finer ones for readers who zoom in
        fine = [t for t in _fine_ticks(ends) if t not in ticks]
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
    return []  # bars are drawn together


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
