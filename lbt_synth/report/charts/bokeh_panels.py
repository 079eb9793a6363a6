"""One panel of a chart for the screen: its axes and marks, with their values on hover."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from lbt_synth.report.charts import scales
from lbt_synth.report.charts.description import (
    GREY,
    PALE,
    SHADE,
    Area,
    Bars,
    Curve,
    Flags,
    Map,
    Mark,
    Panel,
    Rule,
    Span,
    colour,
    dashes,
    marker_name,
)
from lbt_synth.validation import FloatArray

_FONT = "system-ui, sans-serif"
_HEIGHT = 300  # of a panel [px]
_MAP_HEIGHT = 380  # of one with a colour scale [px]
_SQUARE = 460  # width of one with equal scales, at most [px]
_BAR = 22  # of one bar [px]
_GLYPHS = {"cross": "x", "plus": "cross"}  # the others have our names
_AXIS = {
    "axis_label_text_font": _FONT,
    "axis_label_text_font_size": "13px",
    "axis_label_text_font_style": "normal",
    "axis_label_text_color": "#222222",
    "major_label_text_font": _FONT,
    "major_label_text_font_size": "12px",
    "major_label_text_color": "#222222",
    "axis_line_color": "#808080",
    "minor_tick_line_color": None,
}


def panel_figure(
    panel: Panel,
    shared: dict[Any, Any],
    named: dict[str, list[str]],
    sources: dict[str, Any] | None = None,
) -> Any:
    """Return the figure of a panel.

    Equal scales are taken from ``shared``; the models of each name are added to ``named``, and the
    sources of the columns of :func:`panel_columns` to ``sources``.
    """
    from bokeh.models import (
        BoxZoomTool,
        ColumnDataSource,
        FixedTicker,
        PanTool,
        PlainText,
        Range1d,
        ResetTool,
        WheelZoomTool,
    )
    from bokeh.plotting import figure as new_figure

    zoom = BoxZoomTool(match_aspect=panel.equal)
    across, up = scales.scale_ends(panel)
    size: dict[str, Any] = {"height": _height(panel)}
    if panel.equal:  # the borders are as wide as the toolbar and the labels are high
        (x0, x1), (y0, y1) = across, up
        size = {"aspect_ratio": abs((x1 - x0) / (y1 - y0)), "max_width": _SQUARE}
    figure = new_figure(
        x_axis_type="log" if panel.x.log else "linear",
        y_axis_type="log" if panel.y.log else "linear",
        x_range=shared.setdefault((panel.x.text, across), Range1d(start=across[0], end=across[1])),
        y_range=Range1d(start=up[0], end=up[1]),
        sizing_mode="stretch_width",
        tools=[zoom, PanTool(), WheelZoomTool(), ResetTool()],
        toolbar_location="above",
        min_border_left=64,  # panels above each other are in line
        min_border_right=12,
        **size,
    )
    figure.toolbar.update(logo=None, active_drag=zoom, active_scroll=None)
    figure.grid.grid_line_color = "#e0e0e0"
    figure.outline_line_color = None
    for axis, shown in ((figure.xaxis[0], panel.x), (figure.yaxis[0], panel.y)):
        axis.update(axis_label=PlainText(text=shown.text), **_AXIS)
        if shown.log:
            axis.ticker = FixedTicker()
    set_scales(figure, panel)
    own = {} if sources is None else sources
    own |= {key: ColumnDataSource(columns) for key, columns in panel_columns(panel).items()}
    _draw_marks(figure, panel, own, named)
    if panel.categories:
        names = {i: scales.shorten(name, 28) for i, name in enumerate(panel.categories)}
        figure.yaxis[0].update(ticker=list(names), major_label_overrides=names, axis_label=None)
        figure.ygrid.grid_line_color = None
    _hover_curves(figure, panel, own)
    return figure


def _draw_marks(
    figure: Any, panel: Panel, own: dict[str, Any], named: dict[str, list[str]]
) -> None:
    """Draw the marks of a panel; curves and rules that look alike share a source."""
    points = {
        id(curve): {"x": "x", "y": f"y{j}", "source": own[f"curves-{i}"]}
        for i, group in enumerate(_curve_groups(panel))
        for j, curve in enumerate(group)
    }
    grouped = set()
    for i, rules in enumerate(_rule_groups(panel)):
        points[id(rules[0])] = {rules[0].axis: "at", "source": own[f"rules-{i}"]}
        grouped |= {id(rule) for rule in rules[1:]}  # drawn with the first
    for mark in panel.marks:
        if id(mark) in grouped:
            continue
        models = _draw(figure, panel, mark, points.get(id(mark), {}))
        if mark.name and models:
            named.setdefault(mark.name, []).extend(model.id for model in models)


def set_scales(figure: Any, panel: Panel) -> None:
    """Give the axes of a figure the ends and ticks of the scales of a panel."""
    axes = ((figure.xaxis[0], figure.x_range), (figure.yaxis[0], figure.y_range))
    for (axis, shown), own, ends in zip(
        axes, (panel.x, panel.y), scales.scale_ends(panel), strict=True
    ):
        if (shown.start, shown.end) != ends:
            shown.update(start=ends[0], end=ends[1])
        if own.log:
            ticks = scales.log_ticks(*ends)
            powers = range(*(int(np.floor(np.log10(end))) + i for i, end in enumerate(ends)))
            # finer ones for readers who zoom in
            fine = [f * 10.0**n for n in powers for f in range(1, 10)]
            minor = [t for t in fine if t not in ticks]
            axis.ticker.update(ticks=ticks, minor_ticks=minor)
            axis.major_label_overrides = dict(zip(ticks, scales.log_tick_texts(ticks), strict=True))


def panel_columns(panel: Panel) -> dict[str, dict[str, FloatArray]]:
    """Return the columns of what a panel draws: one source per group of curves or of rules.

    Curves of the same abscissae are a group: x, the ordinate of each, and the height ``at`` which
    their values are shown. Rules that look alike are a group, and stand ``at`` their places.
    """
    columns: dict[str, dict[str, FloatArray]] = {}
    for i, group in enumerate(_curve_groups(panel)):
        heights = [np.array(curve.y) for curve in group]
        x = np.array(group[0].x)
        if panel.x.log:
            x = np.where(x > 0, x, np.nan)
        if panel.y.log:
            heights = [np.where(y > 0, y, np.nan) for y in heights]
        columns[f"curves-{i}"] = {"x": x} | {f"y{j}": y for j, y in enumerate(heights)}
        if group[0].hover:
            at = _mean_height(np.array(heights), log=panel.y.log)
            columns[f"curves-{i}"]["at"] = at
    for i, rules in enumerate(_rule_groups(panel)):
        columns[f"rules-{i}"] = {"at": np.array([rule.at for rule in rules])}
    return columns


def _rule_groups(panel: Panel) -> list[list[Rule]]:
    """Return the rules of a panel, those that look alike together."""
    groups: dict[object, list[Rule]] = {}
    for rule in panel.select(Rule):
        groups.setdefault((rule.name, rule.axis, rule.dash), []).append(rule)
    return list(groups.values())


def _curve_groups(panel: Panel) -> list[list[Curve]]:
    """Return the curves that have points, those with a line and the same abscissae together."""
    groups: dict[object, list[Curve]] = {}
    for curve in panel.select(Curve):
        if curve.x.size:
            joined = curve.line and curve.hover
            groups.setdefault(curve.x.tobytes() if joined else curve, []).append(curve)
    return list(groups.values())


def _height(panel: Panel) -> int:
    if panel.categories:
        return 90 + _BAR * len(panel.categories) * max(1, len(panel.select(Bars)))
    if panel.select(Map):
        return _MAP_HEIGHT
    return _HEIGHT if panel.height_in is None else int(60 + 115 * panel.height_in)


def _draw(figure: Any, panel: Panel, mark: Mark, points: dict[str, Any]) -> list[Any]:
    """Draw a mark, and return the models that a legend hides with it.

    The points of a curve, or the place of a rule, are columns of a source; without them the curve
    is empty.
    """
    match mark:
        case Curve():
            return _draw_curve(figure, mark, points) if points else []
        case Area():
            alpha = 1.0 if mark.solid else SHADE
            shade = colour(mark.look)
            return [figure.varea(mark.x, mark.low, mark.high, color=shade, alpha=alpha)]
        case Rule():
            draw = figure.vspan if mark.axis == "x" else figure.hspan
            # a list would be a column of the source
            strokes = " ".join(f"{round(3 * s)}" for s in dashes(mark.dash)) or "solid"
            style = {"line_color": GREY, "line_width": 1.2, "line_dash": strokes}
            return [draw(**points, **style)]
        case Span():
            draw = figure.vstrip if mark.axis == "x" else figure.hstrip
            ends = {f"{mark.axis}0": [mark.low], f"{mark.axis}1": [mark.high]}
            style = {"fill_color": colour(mark.look), "fill_alpha": SHADE, "line_color": None}
            return [draw(**ends, **style)]
        case Bars():
            return _draw_bars(figure, panel, mark)
        case Flags():
            style = {"angle": np.pi / 2, "text_font_size": "10px", "text_baseline": "middle"}
            return [figure.text(mark.x, mark.y, text=list(mark.texts), x_offset=0, **style)]
        case Map():
            _draw_map(figure, panel, mark)
    return []


def _draw_curve(figure: Any, curve: Curve, points: dict[str, Any]) -> list[Any]:
    shade, drawn = colour(curve.look), []
    if curve.line:
        number = curve.look if curve.dash is None else curve.dash
        strokes = [max(1, round(2.4 * s)) for s in dashes(number)]
        style = {"line_color": shade, "line_width": 1.25 * curve.width, "line_dash": strokes}
        style["line_alpha"] = curve.opacity
        if curve.step:
            drawn.append(figure.step(**points, mode=curve.step, **style))
        else:
            drawn.append(figure.line(**points, **style))
    if curve.error is not None:
        ends = (curve.x, curve.y - curve.error, curve.x, curve.y + curve.error)
        drawn.append(figure.segment(*ends, line_color=shade))
    if curve.marker is not None:
        name = marker_name(curve.marker, curve.look)
        drawn.append(
            figure.scatter(
                **points,
                marker=_GLYPHS.get(name, name),
                size=1.6 * curve.size,
                line_color=shade,
                fill_color=shade if curve.filled else None,
                line_width=1.5,
            )
        )
    return drawn


def _draw_bars(figure: Any, panel: Panel, bars: Bars) -> list[Any]:
    series = panel.select(Bars)
    offset, height = scales.bar_places(len(series))[series.index(bars)]
    drawn = np.flatnonzero(np.isfinite(bars.values))
    source = {
        "y": drawn + offset,
        "right": bars.values[drawn],
        "category": [panel.categories[i] for i in drawn],
    }
    tips = [
        (panel.y.label or "bar", "@category"),
        (bars.name or panel.x.label, _value_format("right", panel.x.unit)),
    ]
    ends = {"low": bars.low, "high": bars.high}
    source |= {name: values[drawn] for name, values in ends.items() if values is not None}
    if bars.low is not None:
        tips.append(("interval", f"@low{{%.4g}} to {_value_format('high', panel.x.unit)}"))
    shade = colour(bars.look)
    box = figure.hbar(y="y", right="right", height=height, color=shade, source=source)
    _add_hover(figure, box, tips, ("right", "low", "high"))
    if bars.low is None:
        return [box]
    line = {"x0": "low", "x1": "high", "y0": "y", "y1": "y", "line_color": "black"}
    return [box, figure.segment(**line, source=box.data_source, line_width=1.5)]


def _draw_map(figure: Any, panel: Panel, found: Map) -> None:
    """Draw a map with its levels, blank cells and colour bar."""
    from bokeh.models import ColorBar, LinearColorMapper, LogColorMapper, PlainText

    figure.grid.grid_line_color = None
    x, y = scales.cell_edges(found.x), scales.cell_edges(found.y)
    known = np.isfinite(found.values)
    rows, columns = np.nonzero(known)
    kind = LogColorMapper if found.log else LinearColorMapper
    mapper = kind(palette="Viridis256", low=found.low, high=found.high)
    edges = {"left": x[columns], "right": x[columns + 1], "bottom": y[rows], "top": y[rows + 1]}
    centres = {"x": found.x[columns], "y": found.y[rows], "value": found.values[known]}
    shade = {"field": "value", "transform": mapper}
    # lines in the same colours leave no seams between cells
    sides = {side: side for side in edges}
    style = {"fill_color": shade, "line_color": shade}
    cells = figure.quad(**sides, **style, source=edges | centres)
    blank = np.array(list(scales.blank_cells(~known, x, y))).reshape(-1, 4).T
    figure.quad(
        **dict(zip(edges, blank, strict=True)),
        fill_color=PALE,
        line_color=None,
        hatch_pattern="right_diagonal_line",
        hatch_color=GREY,
        hatch_alpha=0.5,
        hatch_weight=0.8,
        hatch_scale=10,
    )
    _draw_levels(figure, found)
    bar = ColorBar(
        color_mapper=mapper,
        height=10,
        title=PlainText(text=found.text),
        padding=6,
        title_text_font=_FONT,
        title_text_font_size="12px",
        title_text_font_style="normal",
        major_label_text_font=_FONT,
        major_label_text_font_size="12px",
    )
    figure.add_layout(bar, "below")
    shown = (("x", panel.x), ("y", panel.y), ("value", found))
    tips = [(what.label, _value_format(column, what.unit)) for column, what in shown]
    _add_hover(figure, cells, tips, centres)


def _draw_levels(figure: Any, found: Map) -> None:
    from contourpy import contour_generator

    levels = scales.levels_within(found.values, found.levels)
    if not levels:
        return
    generator = contour_generator(found.x, found.y, np.ma.masked_invalid(found.values))
    lines = [(path, level) for level in levels for path in generator.lines(level)]
    figure.multi_line(
        [path[:, 0] for path, _ in lines],
        [path[:, 1] for path, _ in lines],
        line_color=[scales.level_colour(level, found.low, found.high) for _, level in lines],
        line_width=1.0,
    )


def _value_format(column: str, unit: str) -> str:
    """Return how a value of a column is shown: four digits and its unit."""
    return f"@{column}{{%.4g}}" + (f" {unit}" if unit and unit != "-" else "")


def _add_hover(
    figure: Any, glyphs: Any, tips: list[tuple[str, str]], columns: Iterable[str], **options: Any
) -> None:
    """Show values under the pointer; columns are those of the source that hold numbers."""
    from bokeh.models import HoverTool

    figure.add_tools(
        HoverTool(
            renderers=[glyphs],
            tooltips=tips,
            formatters={f"@{name}": "printf" for name in columns},
            visible=False,
            **options,
        )
    )


def _hover_curves(figure: Any, panel: Panel, sources: dict[str, Any]) -> None:
    """Show the values of all curves of the same abscissae in one box."""
    for i, group in enumerate(_curve_groups(panel)):
        if not group[0].hover:
            continue
        joined, source = group[0].line, sources[f"curves-{i}"]
        tips = [(panel.x.label, _value_format("x", panel.x.unit))]
        tips += [
            (curve.name or panel.y.label, _value_format(f"y{j}", panel.y.unit))
            for j, curve in enumerate(group)
        ]
        # what the box follows: the finite mean, or the points themselves
        follower = (
            figure.line("x", "at", source=source, line_alpha=0)
            if joined
            else figure.scatter("x", "at", source=source, size=12, line_alpha=0, fill_alpha=0)
        )
        mode = "vline" if joined else "mouse"
        _add_hover(figure, follower, tips, source.data, mode=mode, line_policy="nearest")


def _mean_height(heights: FloatArray, *, log: bool) -> FloatArray:
    """Mean of several curves at each abscissa, (curves, n) -> (n,); nan where none has a value."""
    shown = np.where(heights > 0, heights, np.nan) if log else heights
    known = np.isfinite(shown)
    filled = np.where(known, np.log(np.where(known, shown, 1.0)) if log else shown, 0.0)
    count = known.sum(axis=0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.exp(mean) if log else mean, np.nan)
