"""Ends and ticks of scales, places of labels, and cells of maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from lbt_synth.validation import BoolArray, FloatArray

ROOM = 0.04  # around what is drawn, as a part of its extent
_DECADES = 8  # of a logarithmic scale at most: a zero must not stretch it
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def scale_ends(
    values: Sequence[FloatArray],
    curves: Sequence[tuple[FloatArray, bool]],
    *,
    log: bool,
    ends: Sequence[float | None],
    room: float,
) -> tuple[float, float]:
    """Return the ends of a scale: those that are given, else those of the values and some room.

    A given end moves out where it would cut a curve. Each curve is a pair of its values and whether
    it has markers.
    """
    shown = np.concatenate([np.zeros(0), *values])
    shown = shown[np.isfinite(shown) & ((shown > 0) | (not log))]
    low, high = (float(shown.min()), float(shown.max())) if shown.size else (1.0, 1.0)
    if log:
        low, high = math.log(low), math.log(high)
        low = max(low, high - _DECADES * math.log(10))
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        half = 0.5 if log or low == 0 else abs(low) / 10
        low, high = low - half, high + half
    fixed = [end if end is None or not log else math.log(end) for end in ends]
    low = low if fixed[0] is None else fixed[0]
    high = high if fixed[1] is None else fixed[1]
    if high <= low:  # all values are beyond the end that is given
        low, high = (low, low + 1.0) if fixed[1] is None else (high - 1.0, high)
    moved = []
    for end, own, sign in zip(fixed, (low, high), (-1, 1), strict=True):
        margin = room
        if end is not None:
            exact = math.exp(end) if log else end
            margin = ROOM if any(_is_cut(v, exact, marked=m) for v, m in curves) else 0.0
        place = own + sign * margin * (high - low)
        moved.append(math.exp(place) if log else place)
    return moved[0], moved[1]


def _is_cut(values: FloatArray, end: float, *, marked: bool) -> bool:
    """Whether an end of a scale cuts a marker, or a line that runs along it."""
    at_end = np.isclose(values, end, rtol=1e-9, atol=1e-12)
    return bool(np.any(at_end) if marked else np.any(at_end[1:] & at_end[:-1]))


def overlap(values: FloatArray | None, ends: tuple[float, float]) -> bool:
    """Whether the range of values and a scale have something in common; None is everywhere."""
    if values is None:
        return True
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.max() >= min(ends) and finite.min() <= max(ends))


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


def cell_edges(centres: FloatArray) -> FloatArray:
    """Return the ends of the cells of increasing values, halfway between them."""
    if centres.size == 1:
        return np.array([centres[0] - 0.05, centres[0] + 0.05])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def blank_cells(
    blank: BoolArray, x: FloatArray, y: FloatArray
) -> Iterator[tuple[float, float, float, float]]:
    """Left, right, low and high end of rectangles that cover the cells without a value."""
    whole = np.all(blank, axis=1)
    for low, high in _marked_intervals(whole, y):
        yield float(x[0]), float(x[-1]), low, high
    for row in np.flatnonzero(~whole):
        for left, right in _marked_intervals(blank[row], x):
            yield left, right, float(y[row]), float(y[row + 1])


def _marked_intervals(marked: BoolArray, edges: FloatArray) -> list[tuple[float, float]]:
    """Intervals that consecutive marked cells cover."""
    steps = np.diff(np.concatenate([[False], marked, [False]]).astype(np.int64))
    starts, ends = np.nonzero(steps > 0)[0], np.nonzero(steps < 0)[0]
    return [(float(edges[i]), float(edges[j])) for i, j in zip(starts, ends, strict=True)]


def levels_within(values: FloatArray, levels: Sequence[float]) -> list[float]:
    """Levels between the least and the largest value of a map."""
    inside = values[np.isfinite(values)]
    if min(values.shape) < 2 or not inside.size:
        return []
    return [level for level in levels if inside.min() < level < inside.max()]
