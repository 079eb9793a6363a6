"""Bars and maps for the screen, with their values on hover."""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.report.line_styles import GREY, PALE, colour
from lbt_synth.report.map_cells import blank_cells, cell_edges, level_colour, levels_within
from lbt_synth.report.page.bokeh_hover import add_hover, value_format
from lbt_synth.report.page.charts import Bars, Map, Panel
from lbt_synth.report.page.scales import bar_places

FONT = "system-ui, sans-serif"


def draw_bars(figure: Any, panel: Panel, named: dict[str, list[str]]) -> None:
    """Draw all bars of a panel, and add their models to those of their names."""
    series = panel.select(Bars)
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
            (bars.name or panel.x.label, value_format("right", panel.x.unit)),
        ]
        if "low" in source:
            ends = {"x0": "low", "x1": "high", "y0": "y", "y1": "y"}
            line = {"line_color": "black", "line_width": 1.5}
            models.append(figure.segment(**ends, source=box.data_source, **line))
            tips.append(("interval", f"@low{{%.4g}} to {value_format('high', panel.x.unit)}"))
        add_hover(figure, box, tips, ("right", "low", "high"))
        if bars.name:
            named.setdefault(bars.name, []).extend(model.id for model in models)


def draw_map(figure: Any, panel: Panel, found: Map) -> None:
    """Draw a map with its levels, blank cells and colour bar."""
    from bokeh.models import ColorBar, LinearColorMapper, PlainText

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
            title_text_font=FONT,
            title_text_font_size="12px",
            title_text_font_style="normal",
            major_label_text_font=FONT,
            major_label_text_font_size="12px",
        ),
        "below",
    )
    tips = [
        (panel.x.label, value_format("x", panel.x.unit)),
        (panel.y.label, value_format("y", panel.y.unit)),
        (found.label, value_format("value", found.unit)),
    ]
    add_hover(figure, cells, tips, ("x", "y", "value"))


def _draw_levels(figure: Any, found: Map) -> None:
    from contourpy import contour_generator

    levels = levels_within(found.values, found.levels)
    if not levels:
        return
    generator = contour_generator(found.x, found.y, np.ma.masked_invalid(found.values))
    paths, shades = [], []
    for level in levels:
        for path in generator.lines(level):
            paths.append(path)
            shades.append(level_colour(level, found.low, found.high))
    figure.multi_line(
        [path[:, 0] for path in paths],
        [path[:, 1] for path in paths],
        line_color=shades,
        line_width=1.0,
    )
