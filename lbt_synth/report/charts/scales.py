"""Scales, ticks, bars, labels and cells of maps, the same on paper and on the screen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from lbt_synth.report.charts.description import (
    Area,
    Axis,
    Bars,
    Curve,
    Map,
    Mark,
    Panel,
    Rule,
    Span,
)
from lbt_synth.validation import BoolArray, FloatArray

STREHL_LEVELS = (10, 20, 30, 40, 50, 60, 70, 75, 80, 83, 86, 90, 95, 98)  # [%]
_DECADES = 8  # of a logarithmic scale at most: a zero must not stretch it
_ROOM = 0.04  # around what is drawn, as a part of its extent
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def scale_ends(panel: Panel) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of the scales of x and y of a panel; categories go from top to bottom."""
    x_values: list[FloatArray] = []
    y_values: list[FloatArray] = []
    for mark in panel.marks:
        match mark:
            case Curve():
                x_values.append(mark.x)
                y_values.append(mark.y)
                if mark.error is not None:
                    y_values += [mark.y - mark.error, mark.y + mark.error]
            case Area():
                x_values.append(mark.x)
                y_values += [mark.low, mark.high]
            case Bars():
                ends = (mark.values, mark.low, mark.high)
                x_values += [np.zeros(1), *(end for end in ends if end is not None)]
            case Map():
                x_values.append(cell_edges(mark.x))
                y_values.append(cell_edges(mark.y))
            case Rule(axis="y"):
                y_values.append(np.array([mark.at]))
    curves, tight = panel.select(Curve), bool(panel.select(Map))
    # lines without markers need no room at the ends of x
    plain = not panel.categories and all(c.line and c.marker is None for c in curves)
    # areas and bars stand on an end of the scale, and equal scales stay equal: move no given end
    if panel.equal or any(isinstance(mark, Map | Area | Bars) for mark in panel.marks):
        curves = []
    x_room = 0.0 if tight or plain else _ROOM
    x = _axis_ends(panel.x, x_values, x_room, [(c.x, c.marker is not None) for c in curves])
    if panel.categories:
        return x, (len(panel.categories) - 0.4, -0.6)
    y_room = 0.0 if tight else _ROOM
    return x, _axis_ends(panel.y, y_values, y_room, [(c.y, c.marker is not None) for c in curves])


def legend_entries(panels: Sequence[Panel]) -> dict[str, Mark]:
    """Return the entries of a legend, each name with the first mark that has it and is seen."""
    found: dict[str, Mark] = {}
    for panel in panels:
        ends = scale_ends(panel)
        for mark in panel.marks:
            if mark.name and _is_seen(mark, *ends):
                found.setdefault(mark.name, mark)
    return found


def _is_seen(mark: Mark, x: tuple[float, float], y: tuple[float, float]) -> bool:
    """Whether a mark reaches into the scales; a curve without points is in the legend only."""
    match mark:
        case Rule():
            return _overlap([mark.at], x if mark.axis == "x" else y)
        case Span():
            return _overlap([mark.low, mark.high], x if mark.axis == "x" else y)
        case Curve() if mark.x.size:
            return _overlap(mark.x, x) and _overlap(mark.y, y)
    return True


def _overlap(values: FloatArray | list[float], ends: tuple[float, float]) -> bool:
    """Whether the range of values and a scale have something in common."""
    known = np.asarray(values)[np.isfinite(values)]
    return bool(known.size and known.max() >= min(ends) and known.min() <= max(ends))


def _axis_ends(
    axis: Axis, values: list[FloatArray], room: float, curves: list[tuple[FloatArray, bool]]
) -> tuple[float, float]:
    """Return the ends of a scale: those of the axis, else those of the values and some room.

    An end of the axis moves out where it would cut a curve. Each curve is a pair of its values
    and whether it has markers.
    """
    shown = np.concatenate([np.zeros(0), *values])
    shown = shown[np.isfinite(shown) & ((shown > 0) | (not axis.log))]
    low, high = (float(shown.min()), float(shown.max())) if shown.size else (1.0, 1.0)
    if axis.log:
        low, high = math.log(low), math.log(high)
        low = max(low, high - _DECADES * math.log(10))
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        half = 0.5 if axis.log or low == 0 else abs(low) / 10
        low, high = low - half, high + half
    given = [end if end is None or not axis.log else math.log(end) for end in (axis.low, axis.high)]
    low = low if given[0] is None else given[0]
    high = high if given[1] is None else given[1]
    if high <= low:  # all values are beyond the end that is given
        low, high = (low, low + 1.0) if given[1] is None else (high - 1.0, high)
    ends = []
    for end, own, sign in zip(given, (low, high), (-1, 1), strict=True):
        margin = room
        if end is not None:
            exact = math.exp(end) if axis.log else end
            margin = _ROOM if any(_is_cut(v, exact, marked=m) for v, m in curves) else 0.0
        moved = own + sign * margin * (high - low)
        ends.append(math.exp(moved) if axis.log else moved)
    return ends[0], ends[1]


def _is_cut(values: FloatArray, end: float, *, marked: bool) -> bool:
    """Whether an end of a scale cuts a marker, or a line that runs along it."""
    at_end = np.isclose(values, end, rtol=1e-9, atol=1e-12)
    return bool(np.any(at_end) if marked else np.any(at_end[1:] & at_end[:-1]))


def keep_apart(boxes: Sequence[tuple[float, float, float, float]]) -> list[bool]:
    """Return which boxes (left, bottom, right, top) stay if none may cover one before it."""
    kept: list[tuple[float, float, float, float]] = []
    stay = []
    for left, bottom, right, top in boxes:
        apart = (right < k[0] or k[2] < left or top < k[1] or k[3] < bottom for k in kept)
        stay.append(all(apart))
        if stay[-1]:
            kept.append((left, bottom, right, top))
    return stay


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
    """Return texts of logarithmic ticks: 0.01, 5, 200; beyond 0.001 to 10⁴ all as 10⁻⁶, 2·10⁵."""
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
    """Return the offset of each series of bars from its category, and the height of its bars."""
    height = 0.8 / max(count, 1)
    return [((i - (count - 1) / 2) * height, 0.9 * height) for i in range(count)]


def spread_labels(places: FloatArray, width: float) -> FloatArray:
    """Return places in (0, 1) for labels of that width near increasing ones; none overlap."""
    gap = min(width, 1 / max(places.size, 1))
    steps = gap * np.arange(places.size)
    least = gap / 2 + steps
    # pushed to the right where they are crowded, and back from the end
    right = np.maximum.accumulate(np.maximum(places, least) - steps) + steps
    ends = 1 - least[::-1]
    left = np.minimum.accumulate((np.minimum(right, ends) - steps)[::-1])[::-1] + steps
    return np.asarray(left)


def count_columns(panels: int) -> int:
    """Return how many panels stand side by side: three, but two if there are four."""
    return 2 if panels == 4 else min(panels, 3)


def cell_edges(centres: FloatArray) -> FloatArray:
    """Return the ends of the cells of increasing values, halfway between them."""
    if centres.size == 1:
        return np.array([centres[0] - 0.05, centres[0] + 0.05])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def marked_intervals(marked: BoolArray, edges: FloatArray) -> list[tuple[float, float]]:
    """Intervals that consecutive marked cells cover."""
    steps = np.diff(np.concatenate([[False], marked, [False]]).astype(np.int64))
    starts, ends = np.nonzero(steps > 0)[0], np.nonzero(steps < 0)[0]
    return [(float(edges[i]), float(edges[j])) for i, j in zip(starts, ends, strict=True)]


def blank_cells(
    blank: BoolArray, x: FloatArray, y: FloatArray
) -> Iterator[tuple[float, float, float, float]]:
    """Left, right, low and high end of rectangles that cover the cells without a value."""
    whole = np.all(blank, axis=1)
    for low, high in marked_intervals(whole, y):
        yield float(x[0]), float(x[-1]), low, high
    for row, (low, high) in enumerate(pairwise(y)):
        if not whole[row]:
            for left, right in marked_intervals(blank[row], x):
                yield left, right, float(low), float(high)


def strehl_scale(strehls: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the ends [%] of one colour scale for several maps of Strehl ratios."""
    values = 100 * np.concatenate([strehl.ravel() for strehl in strehls])
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 100.0
    low, high = float(values.min()), float(values.max())
    return (low, high) if high - low > 1 else (low - 0.5, high + 0.5)


def levels_within(values: FloatArray, levels: Sequence[float]) -> list[float]:
    """Levels between the least and the largest value of a map."""
    inside = values[np.isfinite(values)]
    if min(values.shape) < 2 or not inside.size:
        return []
    return [level for level in levels if inside.min() < level < inside.max()]


def level_colour(level: float, low: float, high: float) -> str:
    """Colour in which a line of equal value is seen on a colour scale with these ends."""
    return "white" if level < (low + high) / 2 else "black"
