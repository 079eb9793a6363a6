"""Ends of scales and the texts of their ticks, the same on paper and on the screen."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from lbt_synth.pages.charts import Area, Axis, Bars, Curve, Map, Panel, Rule
from lbt_synth.plotting.cells import cell_edges
from lbt_synth.validation import FloatArray

_ROOM = 0.04  # around what is drawn, of its extent
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def ends_of(panel: Panel) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of both scales of a panel."""
    across, up = [], []
    tight = False
    for mark in panel.marks:
        if isinstance(mark, Curve):
            across.append(mark.x)
            up.append(mark.y)
        elif isinstance(mark, Area):
            across.append(mark.x)
            up += [mark.low, mark.high]
        elif isinstance(mark, Bars):
            across += [
                np.zeros(1),
                *(v for v in (mark.values, mark.low, mark.high) if v is not None),
            ]
        elif isinstance(mark, Map):
            across.append(cell_edges(mark.x))
            up.append(cell_edges(mark.y))
            tight = True
        elif isinstance(mark, Rule) and mark.axis == "y":
            up.append(np.array([mark.at]))
    x = _ends(panel.x, across, 0.0 if tight or _is_line(panel) else _ROOM)
    if panel.categories:
        return x, (len(panel.categories) - 0.4, -0.6)
    return x, _ends(panel.y, up, 0.0 if tight else _ROOM)


def _is_line(panel: Panel) -> bool:
    """Whether everything is a line, which may reach from end to end."""
    return not panel.categories and all(
        mark.line and mark.marker is None for mark in panel.of(Curve)
    )


def _ends(axis: Axis, values: Iterable[FloatArray], room: float) -> tuple[float, float]:
    found = np.concatenate([np.zeros(0), *values])
    found = found[np.isfinite(found) & ((found > 0) | (not axis.log))]
    low, high = (float(found.min()), float(found.max())) if found.size else (1.0, 1.0)
    if axis.log:
        low, high = math.log(low), math.log(high)
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        half = 0.5 if axis.log or low == 0 else abs(low) / 10
        low, high = low - half, high + half
    low, high = low - room * (high - low), high + room * (high - low)
    if axis.log:
        low, high = math.exp(low), math.exp(high)
    return (
        low if axis.low is None else axis.low,
        high if axis.high is None else axis.high,
    )


def log_ticks(low: float, high: float) -> list[float]:
    """Return ticks of a logarithmic scale: decades, and 2 and 5 between where these are few."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    factors = (1, 2, 5) if math.log10(high / low) < 2.2 else (1,)
    stride = max(1, math.ceil((last - first) / 8))
    ticks = [f * 10.0**n for n in range(first, last + 1, stride) for f in factors]
    return [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]


def log_tick_text(value: float) -> str:
    """Return a tick of a logarithmic scale as a text: 0.01, 5, 200, 10⁻⁶."""
    if 1e-3 * 0.999 <= value <= 1e4 * 1.001:
        return f"{value:g}"
    power = math.floor(math.log10(value) + 1e-9)
    factor = round(value / 10.0**power)
    raised = "10" + str(power).translate(_RAISED)
    return raised if factor == 1 else f"{factor}·{raised}"


def shortened(text: str, most: int) -> str:
    """Return a text of so many characters at most, its middle left out."""
    if len(text) <= most:
        return text
    kept = most - 1
    return text[: (kept + 1) // 2] + "…" + text[len(text) - kept // 2 :]
