"""Charts of a study, made of binned data, so that their size does not grow with the samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lbt_synth.report.charts.description import Area, Axis, Bars, Chart, Curve, Map, Panel, Rule
from lbt_synth.report.page.words import chart
from lbt_synth.storage.words import listing_text
from lbt_synth.studies.study.statistics import (
    ControllerSamples,
    StudyStatistics,
    is_list,
    sample_losses,
)
from lbt_synth.validation import FloatArray

_UNSTABLE_PANELS = 4
_POINTS = 200  # of a cumulative distribution
_BINS = 30  # of a histogram, at most
_CELLS = 32  # along either axis of a map, at most
_WITHIN = 1, 99  # percentiles at the edges of a map; its outermost cells hold what is beyond
_PER_CELL = 8  # samples in a cell of a map on average, at least
_HIGH = 40.0  # Strehl ratio [%] above which the axis need not start at 0
Names = Mapping[str, str]  # what each parameter is called


def distribution_chart(found: Sequence[ControllerSamples]) -> list[Chart]:
    """Cumulative distribution of the Strehl ratio, and its lower tail on a logarithmic scale."""
    plain, tail, medians = [], [], []
    top, most = 0.0, 1.0
    for look, each in enumerate(found):
        values = each.strehl[each.evaluated]
        if not values.size:
            medians.append(f"{each.controller} has none")
            continue
        medians.append(f"{each.controller} has a median of {100 * np.median(values):.1f} %")
        level, part = cumulative_points(values)
        # from nothing just below the first value
        x, y = 100 * np.append(level[:1], level), 100 * np.append(0.0, part)
        top, most = max(top, float(x[-1])), min(most, 1 / values.size)
        plain.append(_steps(each.controller, x, y, look))
        tail.append(_steps(each.controller, x[1:], y[1:], look))
    if not plain:
        return []
    low = min(10.0, 10.0 ** np.floor(np.log10(100 * most)))
    across = Axis(label="Strehl ratio", unit="%", low=0, high=min(100.0, max(1.02 * top, 1.0)))
    label, half = "samples at or below", Rule(name="half of the samples", at=50, axis="y")
    panels = (
        Panel(
            x=across,
            y=Axis(label=label, unit="%", low=0, high=100),
            marks=(half, *plain),
            title="all samples",
        ),
        Panel(
            x=across,
            y=Axis(label=label, unit="%", log=True, low=low, high=100),
            marks=tuple(tail),
            title="lower tail",
        ),
    )
    return [chart("distribution", panels, columns=2, medians="; ".join(medians))]


def _steps(name: str, x: FloatArray, y: FloatArray, look: int) -> Curve:
    return Curve(name=name, x=x, y=y, look=look, step="after", width=1.8)


def loss_chart(found: Sequence[ControllerSamples]) -> list[Chart]:
    """How much each controller loses against the best of each sample, and how often."""
    losses = sample_losses(found)
    if len(found) < 2 or not losses[0].size:
        return []
    curves = []
    for look, (each, loss) in enumerate(zip(found, losses, strict=True)):
        level, part = cumulative_points(loss)
        x, y = np.append(0.0, level), np.append(1.0, 1 - part)
        curves.append(_steps(each.controller, 100 * x, 100 * y, look))
    panel = Panel(
        x=Axis(label="loss of Strehl ratio", unit="points", low=0),
        y=Axis(label="samples that lose more", unit="%", low=0, high=100),
        marks=tuple(curves),
    )
    return [chart("loss", [panel])]


def parameter_chart(parameters: Mapping[str, FloatArray], names: Names) -> list[Chart]:
    """Histograms of the parameters that vary."""
    panels = []
    for name, values in parameters.items():
        if np.ptp(values) == 0:
            continue
        listed = value_shares(values)
        marks: tuple[Area | Curve, ...]
        if listed is not None:
            places, part = listed
            x, y = np.repeat(places, 3), np.zeros(3 * len(places))
            y[1::3] = 100 * part
            x[2::3] = np.nan  # the stems are not joined
            marks = (
                Curve(name="", x=x, y=y, dash=0, width=5, hover=False),
                Curve(name="", x=places, y=100 * part, line=False, marker="circle"),
            )
        else:
            edges, part = histogram(values)
            x, y = np.repeat(edges, 2), np.concatenate(([0.0], np.repeat(100 * part, 2), [0.0]))
            marks = (
                Area(name="", x=x, low=np.zeros_like(y), high=y),
                Curve(name="", x=x, y=y, dash=0, hover=False),
            )
        y_axis = Axis(label="samples", unit="%", low=0)
        panels.append(Panel(x=Axis(label=names[name]), y=y_axis, marks=marks, height_in=1.7))
    return _parameter_chart("parameters", panels, 3)


def _parameter_chart(key: str, panels: Sequence[Panel], columns: int) -> list[Chart]:
    """Return a chart of panels that have a parameter each, none if there is no panel."""
    if not panels:
        return []
    listed = listing_text([panel.x.label for panel in panels])
    return [chart(key, panels, columns=min(len(panels), columns), names=listed)]


def sensitivity_chart(statistics: StudyStatistics, names: Names) -> list[Chart]:
    """First-order indices as bars, one series per controller."""
    varying = statistics.ranked
    if not varying:
        return []
    bars, strongest = [], []
    for look, one in enumerate(statistics.controllers):
        value = 100 * np.array([one.sensitivity[name]["index"] for name in varying])
        error = 200 * np.array([one.sensitivity[name]["index_error"] for name in varying])
        shown, low, high = np.maximum((value, value - error, value + error), 0)
        bars.append(Bars(name=one.controller, values=shown, low=low, high=high, look=look))
        first = one.ranked[:1]
        strongest += [
            f"{one.controller} depends most on {name}, {100 * one.sensitivity[name]['index']:.0f} %"
            for name in first
        ] or [f"{one.controller} has none"]
    panel = Panel(
        x=Axis(label="variance explained by itself", unit="%", low=0),
        y=Axis(label=""),
        marks=tuple(bars),
        categories=tuple(names[name] for name in varying),
    )
    return [chart("sensitivity", [panel], strongest="; ".join(strongest))]


def conditional_charts(statistics: StudyStatistics, names: Names) -> list[Chart]:
    """Mean and 10th percentile of the Strehl ratio over each parameter, and unstable loops.

    The latter are drawn over the parameters that their part changes most with.
    """
    panels, unstable = [], []
    for name in statistics.ranked:
        marks, parts = [], []
        least, span = 100.0, 0.0
        for look, one in enumerate(statistics.controllers):
            if (curve := one.curves.get(name)) is None:
                continue
            style: dict[str, Any] = {"x": curve["parameter"], "look": look}
            own = style | {"name": one.controller, "marker": "own", "width": 1.8}
            mean, low = 100 * curve["mean"], 100 * curve["low"]
            marks += [Curve(y=mean, **own), Curve(name="", y=low, width=0.9, hover=False, **style)]
            least = min(least, float(np.min(low)))
            if curve["unstable"].any():
                parts.append(Curve(y=100 * curve["unstable"], **own))
                span = max(span, float(np.ptp(curve["unstable"])))
        x = Axis(label=names[name])
        y = Axis(label="Strehl ratio", unit="%", low=0 if least < _HIGH else None)
        panels.append(Panel(x=x, y=y, marks=tuple(marks)))
        if parts:
            y = Axis(label="unstable", unit="%", low=0)
            unstable.append((span, Panel(x=x, y=y, marks=tuple(parts))))
    most = sorted(unstable, key=lambda pair: -pair[0])[:_UNSTABLE_PANELS]
    return [
        *_parameter_chart("curves", panels, 2),
        *_parameter_chart("unstable", [panel for _, panel in most], 2),
    ]


def map_charts(
    statistics: StudyStatistics,
    found: Sequence[ControllerSamples],
    parameters: Mapping[str, FloatArray],
    names: Names,
) -> list[Chart]:
    """Mean Strehl ratio over the two most influential parameters, one chart per controller."""
    charts = []
    for place, (one, each) in enumerate(zip(statistics.controllers, found, strict=True)):
        if len(one.ranked) < 2:
            continue
        first, second = one.ranked[:2]
        kept = each.evaluated
        places = parameters[first][kept], parameters[second][kept]
        columns, rows, mean = binned_map(*places, each.strehl[kept])
        low, high = (100 * float(end(mean)) for end in (np.nanmin, np.nanmax))
        mark = Map(
            x=columns,
            y=rows,
            values=100 * mean,
            label="mean Strehl ratio",
            unit="%",
            low=5 * np.floor(low / 5),
            high=5 * np.floor(high / 5) + 5,
            blank="no sample",
        )
        x, y = names[first], names[second]
        charts.append(
            chart(
                f"map-{place + 1}",
                [Panel(x=Axis(label=x), y=Axis(label=y), marks=(mark,))],
                words="study-map",
                controller=each.controller,
                x=x,
                y=y,
                x_path=first,
                y_path=second,
                low=f"{low:.1f}",
                high=f"{high:.1f}",
            )
        )
    return charts


def cumulative_points(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return levels (k,) and the part of the values at or below each, denser in the tails."""
    ordered, n = np.sort(values), len(values)
    ranks = np.arange(n)
    if n > 2 * _POINTS:
        tail = np.geomspace(1, n / 4, _POINTS // 4).astype(np.int64) - 1
        even = np.linspace(0, n - 1, _POINTS).astype(np.int64)
        ranks = np.concatenate((tail, n - 1 - tail, even))
    level = np.unique(ordered[ranks])
    return level, np.searchsorted(ordered, level, side="right") / n


def histogram(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return edges of bins (k + 1,) and the part of the values in each (k,)."""
    bins = int(np.clip(np.sqrt(len(values)), 4, _BINS))
    counts, edges = np.histogram(values, bins=bins)
    return edges, counts / len(values)


def value_shares(values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the distinct values of a list parameter and their parts; None if it is no list."""
    if not is_list(np.sort(values)):
        return None
    distinct, counts = np.unique(values, return_counts=True)
    return distinct, counts / len(values)


def binned_map(
    x: FloatArray, y: FloatArray, result: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean of a result (n,) over a grid of two varying parameters (n,).

    It is (ny, nx), nan in a cell without samples, and comes after the centres of the cells, or
    the values of a list, x (nx,) and y (ny,).
    """
    cells = len(x) / _PER_CELL
    lists = [value_shares(x), value_shares(y)]
    for listed in lists:
        cells /= 1 if listed is None else len(listed[0])
    width = int(np.clip(cells ** (1 / max(lists.count(None), 1)), 3, _CELLS))
    (columns, x_edges), (rows, y_edges) = (
        _cells(values, listed, width) for values, listed in zip((x, y), lists, strict=True)
    )
    samples = np.histogram2d(y, x, bins=(y_edges, x_edges))[0]
    sums = np.histogram2d(y, x, bins=(y_edges, x_edges), weights=result)[0]
    mean = np.full(samples.shape, np.nan)
    np.divide(sums, samples, out=mean, where=samples > 0)
    return columns, rows, mean


def _cells(
    values: FloatArray, listed: tuple[FloatArray, FloatArray] | None, cells: int
) -> tuple[FloatArray, FloatArray]:
    """Return the centres of the cells along one axis, and their edges."""
    if listed is not None:
        centres = listed[0]
        inner = (centres[:-1] + centres[1:]) / 2
    else:
        low, high = np.percentile(values, _WITHIN)
        if not low < high:
            low, high = float(np.min(values)), float(np.max(values))
        edges = np.linspace(low, high, cells + 1)
        centres, inner = (edges[:-1] + edges[1:]) / 2, edges[1:-1]
    return centres, np.concatenate(([-np.inf], inner, [np.inf]))
