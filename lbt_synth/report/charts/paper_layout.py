"""Where the panels of a figure stand on paper, in inches.

The layout is fixed, so that the same chart is always the same drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lbt_synth.report.charts.description import Bars, Map, Panel
from lbt_synth.report.charts.scales import legend_entries, scale_ends, shorten

WIDTH_IN = 7.0
LETTER_IN = 0.068  # width of a letter at 8 points, generously
LONGEST_NAME = 60  # letters of a name in a legend
LONGEST_CATEGORY = 36
_PANEL, _BAR = 2.1, 0.24  # height of a panel, and of one bar
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.62, 0.12, 0.42, 0.08  # around the axes
_TITLE, _LEGEND_ROW, _SCALE = 0.22, 0.2, 0.62
_HIGHEST = 7.5  # of a panel with bars, so that it fits a sheet


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Size of a figure, and the places of what is on it [inch]."""

    height: float
    legend_top: float  # from the upper edge, like all heights
    legend_columns: int
    boxes: tuple[tuple[float, float, float, float], ...]  # left, top, width and height of the axes


def lay_out(panels: Sequence[Panel], columns: int, title: str = "") -> Layout:
    """Return the layout of panels, row by row, below a title and a legend."""
    categories = [shorten(name, LONGEST_CATEGORY) for p in panels for name in p.categories]
    margin = 0.25 + LETTER_IN * max(map(len, categories)) if categories else _LEFT
    cell = WIDTH_IN / columns
    inside = cell - margin - _RIGHT
    depth = legend_top = _TITLE * bool(title)
    names = [shorten(name, LONGEST_NAME) for name in legend_entries(panels)]
    legend_columns = 1
    if names:
        widest = 0.55 + LETTER_IN * max(map(len, names))
        legend_columns = int(max(1, min(len(names), (WIDTH_IN - 0.2) // widest)))
        depth += 0.1 + _LEGEND_ROW * -(-len(names) // legend_columns)
    # one colour scale, below the last of the maps
    last_map = max((i for i, panel in enumerate(panels) if panel.select(Map)), default=-1)
    boxes = []
    for start in range(0, len(panels), columns):
        row = panels[start : start + columns]
        depth += _TOP + _TITLE * any(panel.title for panel in row)
        height = max(_panel_height(panel, inside) for panel in row)
        boxes += [(i * cell + margin, depth, inside, height) for i in range(len(row))]
        depth += height + _BOTTOM + _SCALE * (start <= last_map < start + columns)
    return Layout(
        height=depth, legend_top=legend_top, legend_columns=legend_columns, boxes=tuple(boxes)
    )


def _panel_height(panel: Panel, width: float) -> float:
    """Height of the axes of a panel of a width."""
    if panel.height_in is not None:
        return panel.height_in
    if panel.equal:
        (x0, x1), (y0, y1) = scale_ends(panel)
        return min(width * abs((y1 - y0) / (x1 - x0)), 5.0)
    if panel.categories:
        bars = len(panel.categories) * max(1, len(panel.select(Bars)))
        return min(max(0.8, _BAR * bars + 0.2), _HIGHEST)
    return _PANEL
