"""Ends of scales and the texts of their ticks, the same on paper and on the screen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from lbt_synth.report.map_cells import cell_edges
from lbt_synth.report.page.charts import Area, Axis, Bars, Curve, Map, Panel, Rule
from lbt_synth.validation import FloatArray

_ROOM = 0.04  # around what is drawn, as a part of its extent
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def scale_ends(panel: Panel) -> tuple[tuple[float, float], tuple[float, float]]:
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
    # a shaded area stands on its end of the scale; equal scales stay equal
    drawn = (
        []
        if tight or panel.equal or panel.select(Area) or panel.select(Bars)
        else panel.select(Curve)
    )
    x = _axis_ends(
        panel.x,
        across,
        0.0 if tight or _has_only_lines(panel) else _ROOM,
        [(curve.x, curve.marker is not None) for curve in drawn],
    )
    if panel.categories:
        return x, (len(panel.categories) - 0.4, -0.6)
    return x, _axis_ends(
        panel.y,
        up,
        0.0 if tight else _ROOM,
        [(curve.y, curve.marker is not None) for curve in drawn],
    )


def _has_only_lines(panel: Panel) -> bool:
    """Whether all curves are plain lines, which may reach from end to end."""
    return not panel.categories and all(
        mark.line and mark.marker is None for mark in panel.select(Curve)
    )


def _axis_ends(
    axis: Axis,
    values: Iterable[FloatArray],
    room: float,
    curves: Sequence[tuple[FloatArray, bool]],
) -> tuple[float, float]:
    """Return the ends of a scale: those of the axis, else those of the values and some room.

    An end of the axis moves out where it would cut a curve; each curve comes with whether it has
    markers.
    """
    found = np.concatenate([np.zeros(0), *values])
    found = found[np.isfinite(found) & ((found > 0) | (not axis.log))]
    low, high = (float(found.min()), float(found.max())) if found.size else (1.0, 1.0)
    if axis.log:
        low, high = math.log(low), math.log(high)
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        half = 0.5 if axis.log or low == 0 else abs(low) / 10
        low, high = low - half, high + half
    given = [end if end is None or not axis.log else math.log(end) for end in (axis.low, axis.high)]
    low, high = (
        end if end is not None else own for end, own in zip(given, (low, high), strict=True)
    )
    if high <= low:  # all values are beyond the end that is given
        low, high = (low, low + 1.0) if given[1] is None else (high - 1.0, high)
    extent = high - low
    ends = []
    for end, own, sign in zip(given, (low, high), (-1, 1), strict=True):
        away = room
        if end is not None:
            exact = math.exp(end) if axis.log else end
            cut = any(_is_cut(v, exact, marked=m) for v, m in curves)
            away = _ROOM if cut else 0.0
        ends.append(own + sign * away * extent)
    if axis.log:
        return math.exp(ends[0]), math.exp(ends[1])
    return ends[0], ends[1]


def _is_cut(values: FloatArray, end: float, *, marked: bool) -> bool:
    """Whether an end of a scale cuts a marker, or a line that runs along it."""
    there = np.isclose(values, end, rtol=1e-9, atol=1e-12)
    return bool(np.any(there) if marked else np.any(there[1:] & there[:-1]))


def log_ticks(low: float, high: float) -> list[float]:
    """Return ticks of a logarithmic scale: decades, with 2 and 5 between if these are few.

    A scale within a decade that would have fewer than three gets round values at equal steps.
    """
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    factors = (1, 2, 5) if math.log10(high / low) < 2.2 else (1,)
    stride = max(1, math.ceil((last - first) / 8))
    ticks = [f * 10.0**n for n in range(first, last + 1, stride) for f in factors]
    inside = [tick for tick in ticks if low * (1 - 1e-9) <= tick <= high * (1 + 1e-9)]
    if len(inside) > 2 or high >= 10 * low:
        return inside
    raw = (high - low) / 5
    unit = 10.0 ** math.floor(math.log10(raw))
    step = min((unit, 2 * unit, 5 * unit, 10 * unit), key=lambda step: abs(math.log(step / raw)))
    return [i * step for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def log_tick_texts(ticks: Sequence[float]) -> list[str]:
    """Return ticks of a logarithmic scale as texts: 0.01, 5, 200; or all as powers: 10⁻⁶, 2·10⁵."""
    if all(1e-3 * 0.999 <= tick <= 1e4 * 1.001 for tick in ticks):
        return [f"{tick:g}" for tick in ticks]
    return [_power_text(tick) for tick in ticks]


def _power_text(value: float) -> str:
    power = math.floor(math.log10(value) + 1e-9)
    factor = f"{value / 10.0**power:.6g}"
    raised = "10" + str(power).translate(_RAISED)
    return raised if factor == "1" else f"{factor}·{raised}"


def shorten(text: str, most: int) -> str:
    """Return a text of at most so many characters, with its middle left out if need be."""
    if len(text) <= most:
        return text
    kept = most - 1
    return text[: (kept + 1) // 2] + "…" + text[len(text) - kept // 2 :]


def bar_places(count: int) -> list[tuple[float, float]]:
    """Offset of each series of bars from its category, and the height of its bars."""
    height = 0.8 / max(count, 1)
    return [((i - (count - 1) / 2) * height, 0.9 * height) for i in range(count)]
