"""Figures drawn by matplotlib: as SVG in a page, as a file, or on a user's own axes."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.report.charts import paper_layout, scales
from lbt_synth.report.charts.description import (
    GREY,
    PALE,
    SHADE,
    Area,
    Bars,
    Chart,
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
from lbt_synth.report.figures.style import house_style
from lbt_synth.storage.warning_filters import ignore_warnings

if TYPE_CHECKING:
    import matplotlib.figure
    from matplotlib.axes import Axes

Figure: TypeAlias = "matplotlib.figure.Figure"
OwnAxes: TypeAlias = "Axes | Sequence[Axes] | None"  # of the user, to draw on
_FLAG_IN = 0.15  # width of an upright text
_MARKERS = {
    "circle": "o",
    "square": "s",
    "triangle": "^",
    "diamond": "D",
    "cross": "x",
    "plus": "+",
}
_STEPS = {None: "default", "after": "steps-post", "center": "steps-mid"}
_BLANK: dict[str, Any] = {"facecolor": PALE, "edgecolor": "0.55", "hatch": "////", "linewidth": 0}


@contextmanager
def _chart_style() -> Iterator[None]:
    """Set the style of charts for the time of the block."""
    import matplotlib as mpl

    # a name in a script that the font does not have stays a name
    missing = ignore_warnings(message=r"Glyph .* missing")
    with house_style(), mpl.rc_context({"svg.fonttype": "none"}), missing:
        yield


def chart_svg(chart: Chart) -> str:
    """Return a chart as an SVG element to be set into a page, whose size follows its place."""
    import matplotlib as mpl

    buffer = io.BytesIO()
    # the salt makes the identifiers of each chart its own
    with _chart_style(), mpl.rc_context({"svg.hashsalt": chart.key}):
        figure = draw_figure(chart.panels, columns=chart.columns)
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue().decode()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    words = f' role="img" aria-label="{escape(chart.alt)}"'
    svg = re.sub(r' width="[^"]*" height="[^"]*"', lambda _: words, svg, count=1)
    svg = svg.replace('<g id="', f'<g id="{chart.key}_')  # the same in every chart
    seen: set[str] = set()

    def named_once(found: re.Match[str]) -> str:
        repeated = found[2] in seen  # the same path, defined again
        seen.add(found[2])
        return found[1] if repeated else found[0]

    return re.sub(r'(<(?:path|image|pattern|clipPath)\b[^>]*?) id="([^"]*)"', named_once, svg)


def draw_figure(
    panels: Sequence[Panel], *, columns: int = 1, title: str = "", axes: OwnAxes = None
) -> Figure:
    """Draw panels, row by row, on a new figure, or each on one of the user's own axes."""
    with _chart_style():
        if axes is None:
            figure, places = _new_places(panels, columns, title)
        else:
            places = _own_places(axes, len(panels))
            figure = places[0].figure
            for place, panel in zip(places, panels, strict=True):
                _draw_legend(place, [panel], loc="best")
        images = [_draw_panel(place, panel) for place, panel in zip(places, panels, strict=True)]
        maps = [panel.select(Map) for panel in panels]
        if any(maps):
            mapped = [place for place, found in zip(places, maps, strict=True) if found]
            image = next(image for image in images if image is not None)
            text = next(found[0].text for found in maps if found)
            _draw_colour_bar(figure, image, text, mapped, below=axes is None)
    return figure


def _own_places(axes: OwnAxes, count: int) -> list[Axes]:
    """Return the user's axes as a list, one per panel."""
    from matplotlib.axes import Axes as Place

    places = list(np.ravel(np.asarray(axes, dtype=object)))
    if len(places) != count or not all(isinstance(place, Place) for place in places):
        given = ", ".join(type(place).__name__ for place in places) or "none"
        raise ProblemError(
            f"axes must be {count} matplotlib Axes, one per panel; got {len(places)} ({given})."
        )
    return places


def _new_places(panels: Sequence[Panel], columns: int, title: str) -> tuple[Figure, list[Axes]]:
    """Return a new figure with its title, its legend and the axes of its panels."""
    from matplotlib.figure import Figure

    layout = paper_layout.lay_out(panels, columns, title)
    width, height = paper_layout.WIDTH_IN, layout.height
    figure = Figure(figsize=(width, height))
    if title:
        figure.text(0.5, 1 - 0.05 / height, title, ha="center", va="top", fontsize=10)
    anchor = (0.5, 1 - layout.legend_top / height)
    ncols = layout.legend_columns
    _draw_legend(figure, panels, loc="upper center", bbox_to_anchor=anchor, ncols=ncols)
    return figure, [
        figure.add_axes((x / width, 1 - (top + high) / height, wide / width, high / height))
        for x, top, wide, high in layout.boxes
    ]


def _draw_legend(owner: Figure | Axes, panels: Sequence[Panel], **options: Any) -> None:
    """Give a figure or axes the legend of panels, if anything in them has a name."""
    entries = scales.legend_entries(panels)
    if not entries:
        return
    # a leading underscore would leave a name out
    names = [f" {name}" if name.startswith("_") else name for name in entries]
    owner.legend(
        [_legend_handle(mark) for mark in entries.values()],
        [scales.shorten(name, paper_layout.LONGEST_NAME) for name in names],
        borderaxespad=0.0,
        handlelength=3.2,
        **options,
    )


def _legend_handle(mark: Mark) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    match mark:
        case Curve():
            return Line2D([], [], **_curve_style(mark))
        case Rule():
            return Line2D([], [], **_rule_style(mark))
        case Area() | Span() | Bars():
            return Patch(**_fill_style(mark))
    return Patch(**_BLANK)


def _curve_style(curve: Curve) -> dict[str, Any]:
    strokes = dashes(curve.look if curve.dash is None else curve.dash)
    style: dict[str, Any] = {
        "color": colour(curve.look),
        "linewidth": curve.width,
        "alpha": curve.opacity if curve.opacity < 1 else None,
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
    line = (0, strokes) if strokes else "-"
    return {"color": GREY, "linewidth": 1.0, "linestyle": line, "zorder": 1.6}


def _fill_style(mark: Area | Span | Bars) -> dict[str, Any]:
    solid = isinstance(mark, Bars) or (isinstance(mark, Area) and mark.solid)
    return {"color": colour(mark.look), "alpha": 1.0 if solid else SHADE, "linewidth": 0}


def _draw_panel(axes: Axes, panel: Panel) -> Any:
    """Draw a panel, and return the image of its map if it has one."""
    image = None
    width_in = axes.get_window_extent().width / axes.figure.dpi
    title = scales.shorten(panel.title, max(8, int(width_in / paper_layout.LETTER_IN)))
    axes.set_title(title, loc="left", parse_math=False)
    # error bars end at the edges of a panel
    low, high = sorted(scales.scale_ends(panel)[1])
    for mark in panel.marks:
        match mark:
            case Curve():
                step = _STEPS[mark.step]
                style = _curve_style(mark) | {"drawstyle": step, "label": mark.name or None}
                axes.plot(mark.x, mark.y, **style)
                if mark.error is not None:
                    ends = np.clip((mark.y - mark.error, mark.y + mark.error), low, high)
                    axes.vlines(mark.x, *ends, color=colour(mark.look), linewidth=1.0)
            case Area():
                edges = np.clip((mark.low, mark.high), low, high)
                axes.fill_between(mark.x, *edges, **_fill_style(mark))
            case Rule():
                draw = axes.axvline if mark.axis == "x" else axes.axhline
                draw(mark.at, label=mark.name or None, **_rule_style(mark))
            case Span():
                shade = axes.axvspan if mark.axis == "x" else axes.axhspan
                shade(mark.low, mark.high, label=mark.name or None, **_fill_style(mark))
            case Map():
                image = _draw_map(axes, mark)
    _draw_bars(axes, panel)
    _set_scales(axes, panel)
    for flags in panel.select(Flags):
        _draw_flags(axes, flags, _FLAG_IN / width_in)
    return image


def _set_scales(axes: Axes, panel: Panel) -> None:
    for end, own, scale in (("x", panel.x, axes.xaxis), ("y", panel.y, axes.yaxis)):
        low, high = scales.scale_ends(panel)[end == "y"]
        if own.log:
            getattr(axes, f"set_{end}scale")("log")
            ticks = scales.log_ticks(low, high)
            scale.set_ticks(ticks, scales.log_tick_texts(ticks))
            scale.set_ticks([], minor=True)
        getattr(axes, f"set_{end}lim")(low, high)
        scale.set_label_text(own.text, parse_math=False)
    if panel.categories:
        names = [scales.shorten(name, paper_layout.LONGEST_CATEGORY) for name in panel.categories]
        axes.set_yticks(range(len(names)), names)
        axes.set_ylabel("")
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
    if panel.equal:
        axes.set_aspect("equal")


def _draw_bars(axes: Axes, panel: Panel) -> None:
    series = panel.select(Bars)
    for bars, (offset, height) in zip(series, scales.bar_places(len(series)), strict=True):
        places = np.arange(len(panel.categories)) + offset
        drawn = np.isfinite(bars.values)
        axes.barh(places[drawn], bars.values[drawn], height=height, color=colour(bars.look))
        if bars.low is not None and bars.high is not None:
            axes.hlines(places, bars.low, bars.high, color="black", linewidth=1.0)


def _draw_flags(axes: Axes, flags: Flags, width: float) -> None:
    """Draw upright texts of a width, a part of that of the panel, without overlaps."""
    points = np.column_stack((flags.x, flags.y))
    across = axes.transAxes.inverted().transform(axes.transData.transform(points))[:, 0]
    places = scales.spread_labels(across, width)
    for text, point, place in zip(flags.texts, points, places, strict=True):
        axes.annotate(
            text,
            xy=(point[0], point[1]),
            xytext=(float(place), 0.985),
            textcoords="axes fraction",
            fontsize=6.5,
            rotation=90,
            ha="center",
            va="top",
            color="0.15",
            arrowprops={
                "arrowstyle": "-",
                "color": "0.6",
                "linewidth": 0.5,
                "relpos": (0.5, 0.0),
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )


def _draw_map(axes: Axes, found: Map) -> Any:
    """Draw cells and lines of equal value, and return what a colour bar needs."""
    from matplotlib.colors import LogNorm, Normalize

    axes.grid(visible=False)
    x, y = scales.cell_edges(found.x), scales.cell_edges(found.y)
    shown = np.ma.masked_invalid(found.values)
    norm = (LogNorm if found.log else Normalize)(found.low, found.high)
    image = axes.pcolormesh(x, y, shown, cmap="viridis", norm=norm, rasterized=True)
    inner = scales.levels_within(found.values, found.levels)
    if inner:
        shades = [scales.level_colour(level, found.low, found.high) for level in inner]
        lines = axes.contour(found.x, found.y, shown, levels=inner, linewidths=0.8, colors=shades)
        texts = axes.clabel(lines, fmt="%g", fontsize=7, inline_spacing=3)
        boxes = [text.get_window_extent().extents for text in texts]
        for text, stays in zip(texts, scales.keep_apart(boxes), strict=True):
            text.set_visible(stays)
    for left, right, low, high in scales.blank_cells(np.isnan(found.values), x, y):
        axes.fill_between([left, right], low, high, **_BLANK)
    return image


def _draw_colour_bar(
    figure: Figure, image: Any, text: str, mapped: list[Axes], *, below: bool
) -> None:
    """Draw one colour bar for all maps: below them on a new figure, beside them on own axes."""
    from matplotlib.colors import LogNorm

    if below:
        boxes = [place.get_position() for place in mapped]
        left, right = min(box.x0 for box in boxes), max(box.x1 for box in boxes)
        height = figure.get_size_inches()[1]
        lowest = min(box.y0 for box in boxes) - 0.6 / height
        where = (left + 0.2 * (right - left), lowest, 0.6 * (right - left), 0.11 / height)
        bar = figure.colorbar(image, cax=figure.add_axes(where), orientation="horizontal")
    else:
        bar = figure.colorbar(image, ax=mapped)
    if isinstance(image.norm, LogNorm):
        ticks = scales.log_ticks(image.norm.vmin, image.norm.vmax)
        bar.set_ticks(ticks, labels=scales.log_tick_texts(ticks))
    bar.set_label(text)
    bar.outline.set_visible(False)
