"""What the pointer shows over a chart on the screen."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from lbt_synth.report.charts.description import Curve, Panel
from lbt_synth.validation import FloatArray


def value_format(column: str, unit: str) -> str:
    """Return how a value of a column is shown: four digits and its unit."""
    return f"@{column}{{%.4g}}" + (f" {unit}" if unit and unit != "-" else "")


def add_hover(
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


def hover_curves(figure: Any, panel: Panel) -> None:
    """Show the values of all curves of the same abscissae in one box."""
    from bokeh.models import ColumnDataSource

    groups: list[list[Curve]] = []
    for curve in panel.select(Curve):
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
        tips = [(panel.x.label, value_format("x", panel.x.unit))]
        tips += [
            (curve.name or panel.y.label, value_format(f"y{i}", panel.y.unit))
            for i, curve in enumerate(group)
        ]
        # what the box follows: the finite mean, or the points themselves
        columns["at"] = _mean_height(np.array([curve.y for curve in group]), log=panel.y.log)
        source = ColumnDataSource(columns)
        follower = (
            figure.line("x", "at", source=source, line_alpha=0)
            if joined
            else figure.scatter("x", "at", source=source, size=12, line_alpha=0, fill_alpha=0)
        )
        mode = "vline" if joined else "mouse"
        add_hover(figure, follower, tips, columns, mode=mode, line_policy="nearest")


def _mean_height(heights: FloatArray, *, log: bool) -> FloatArray:
    """Mean of several curves at each abscissa, (curves, n) -> (n,); nan where none has a value."""
    shown = np.where(heights > 0, heights, np.nan) if log else heights
    known = np.isfinite(shown)
    filled = np.where(known, np.log(np.where(known, shown, 1.0)) if log else shown, 0.0)
    count = known.sum(axis=0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.exp(mean) if log else mean, np.nan)
