"""Charts of a study, made of binned data, so that their size does not grow with the samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from lbt_synth.report.charts.description import Area, Axis, Bars, Chart, Curve, Map, Panel, Rule
from lbt_synth.report.number_text import listing_text
from lbt_synth.studies import StudyStatistics
from lbt_synth.studies.study.binning import binned_map, cumulative_points, histogram, value_shares
from lbt_synth.studies.study.comparison import sample_losses
from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.studies.study.sensitivity import ConditionalCurve
from lbt_synth.studies.study.summary import varying_parameters
from lbt_synth.validation import FloatArray

_UNSTABLE_PANELS = 4
_HIGH = 40.0  # Strehl ratio [%] above which the axis need not start at 0


def distribution_chart(found: Sequence[ControllerSamples]) -> Chart | None:
    """Cumulative distribution of the Strehl ratio, and its lower tail on a logarithmic scale."""
    curves = []
    most = 1.0
    for look, each in enumerate(found):
        values = each.strehl[each.evaluated]
        if not values.size:
            continue
        most = min(most, 1 / values.size)
        level, part = cumulative_points(values)
        # from nothing just below the first value
        x, y = np.concatenate((level[:1], level)), np.concatenate(([0.0], part))
        curves.append((look, each.controller, 100 * x, 100 * y))
    if not curves:
        return None
    top = max(float(x[-1]) for _, _, x, _ in curves)
    low = min(10.0, 10.0 ** np.floor(np.log10(100 * most)))
    plain, tail = (
        [
            Curve(name=name, x=x[first:], y=y[first:], look=look, step="after", width=1.8)
            for look, name, x, y in curves
        ]
        for first in (0, 1)
    )
    across = Axis(label="Strehl ratio", unit="%", low=0, high=min(100.0, max(1.02 * top, 1.0)))
    part_label = "samples at or below"
    return Chart(
        key="distribution",
        title="Distribution of the Strehl ratio",
        caption=(
            "Part of the samples whose Strehl ratio is at or below the value on the axis; further "
            "to the right is better. An unstable loop counts as 0: the height at 0 is the part "
            "that is unstable. The second panel shows the same on a logarithmic scale, for the "
            "rare bad nights."
        ),
        alt="Cumulative distributions of the Strehl ratio: "
        + "; ".join(_median_text(each) for each in found)
        + ".",
        panels=(
            Panel(
                x=across,
                y=Axis(label=part_label, unit="%", low=0, high=100),
                marks=(Rule(name="half of the samples", at=50, axis="y"), *plain),
                title="all samples",
            ),
            Panel(
                x=across,
                y=Axis(label=part_label, unit="%", log=True, low=low, high=100),
                marks=tuple(tail),
                title="lower tail",
            ),
        ),
        columns=2,
    )


def loss_chart(found: Sequence[ControllerSamples]) -> Chart | None:
    """How much each controller loses against the best of each sample, and how often."""
    losses = sample_losses(found)
    if len(found) < 2 or not losses[0].size:
        return None
    curves = []
    for look, (each, loss) in enumerate(zip(found, losses, strict=True)):
        level, part = cumulative_points(loss)
        x, y = np.concatenate(([0.0], level)), np.concatenate(([1.0], 1 - part))
        curves.append(
            Curve(name=each.controller, x=100 * x, y=100 * y, look=look, step="after", width=1.8)
        )
    x_axis = Axis(label="loss of Strehl ratio", unit="points", low=0)
    y_axis = Axis(label="samples that lose more", unit="%", low=0, high=100)
    return Chart(
        key="loss",
        title="Loss against the best controller of each sample",
        caption=(
            "Part of the samples in which a controller has a Strehl ratio that is lower than that "
            "of the best one of the same sample by more than the points on the axis; lower is "
            "better. What a controller would gain if it could be changed with the conditions."
        ),
        alt="For each controller, the part of the samples over the loss of Strehl ratio.",
        panels=(Panel(x=x_axis, y=y_axis, marks=tuple(curves)),),
    )


def parameter_chart(parameters: Mapping[str, FloatArray], names: Mapping[str, str]) -> Chart | None:
    """Histograms of the parameters that vary."""
    panels = []
    for name, values in parameters.items():
        if np.ptp(values) == 0:
            continue
        listed = value_shares(values)
        if listed is not None:
            places, part = listed
            x, y = np.repeat(places, 3), np.zeros(3 * len(places))
            y[1::3] = 100 * part
            x[2::3] = np.nan  # the stems are not joined
            panels.append(
                _histogram_panel(
                    names[name],
                    Curve(name="", x=x, y=y, look=0, dash=0, width=5, hover=False),
                    Curve(name="", x=places, y=100 * part, look=0, line=False, marker="circle"),
                )
            )
            continue
        edges, part = histogram(values)
        x, y = np.repeat(edges, 2), np.concatenate(([0.0], np.repeat(100 * part, 2), [0.0]))
        panels.append(
            _histogram_panel(
                names[name],
                Area(name="", x=x, low=np.zeros_like(y), high=y, look=0),
                Curve(name="", x=x, y=y, look=0, dash=0, hover=False),
            )
        )
    if not panels:
        return None
    return Chart(
        key="parameters",
        title="Histograms of the parameters",
        caption="Part of the samples in each bin of a parameter, or at each value of a list.",
        alt="Histograms of " + ", ".join(panel.x.label for panel in panels) + ".",
        panels=tuple(panels),
        columns=min(len(panels), 3),
    )


def _histogram_panel(name: str, *marks: Area | Curve) -> Panel:
    return Panel(
        x=Axis(label=name), y=Axis(label="samples", unit="%", low=0), marks=marks, height_in=1.7
    )


def sensitivity_chart(statistics: StudyStatistics, names: Mapping[str, str]) -> Chart | None:
    """First-order indices as bars, one series per controller."""
    varying = varying_parameters(statistics)
    if not varying:
        return None
    bars = []
    for look, one in enumerate(statistics.sensitivities):
        by_name = {each.parameter: each.index for each in one.parameters}
        value = 100 * np.array([by_name[name].value for name in varying])
        error = 200 * np.array([by_name[name].error for name in varying])
        bars.append(
            Bars(
                name=one.controller,
                values=np.maximum(value, 0),
                low=np.maximum(value - error, 0),
                high=np.maximum(value + error, 0),
                look=look,
            )
        )
    return Chart(
        key="sensitivity",
        title="Indices of first order",
        caption=(
            "Part of the variance of the Strehl ratio that each parameter explains by itself, with "
            "two standard errors. What is missing to 100 % is due to parameters that act together."
        ),
        alt="Bars: " + "; ".join(_strongest_text(statistics, i) for i in range(len(bars))) + ".",
        panels=(
            Panel(
                x=Axis(label="variance explained by itself", unit="%", low=0),
                y=Axis(label=""),
                marks=tuple(bars),
                categories=tuple(names[name] for name in varying),
            ),
        ),
    )


def conditional_chart(statistics: StudyStatistics, names: Mapping[str, str]) -> Chart | None:
    """Mean and 10th percentile of the Strehl ratio over each parameter."""
    panels = []
    for name in varying_parameters(statistics):
        marks: list[Curve] = []
        least = 100.0
        for look, controller, curve in _conditional_curves(statistics, name):
            marks += _mean_and_low(controller, curve, look)
            least = min(least, 100 * float(np.min(curve.low)))
        panels.append(
            Panel(
                x=Axis(label=names[name]),
                y=Axis(label="Strehl ratio", unit="%", low=0 if least < _HIGH else None),
                marks=tuple(marks),
            )
        )
    if not panels:
        return None
    return Chart(
        key="curves",
        title="Strehl ratio over each parameter",
        caption=(
            "Mean over the samples of each group of a parameter, all others as they come "
            "(with markers), and the 10th percentile (thin, without): one night in ten is below it."
        ),
        alt="Mean and 10th percentile of the Strehl ratio over "
        + listing_text([panel.x.label for panel in panels])
        + ".",
        panels=tuple(panels),
        columns=min(len(panels), 2),
    )


def _conditional_curves(
    statistics: StudyStatistics, parameter: str
) -> Iterator[tuple[int, str, ConditionalCurve]]:
    """Yield look, controller and curve of all controllers that have one over a parameter."""
    for look, one in enumerate(statistics.sensitivities):
        curve = next(each.curve for each in one.parameters if each.parameter == parameter)
        if curve is not None:
            yield look, one.controller, curve


def _mean_and_low(name: str, curve: ConditionalCurve, look: int) -> list[Curve]:
    x = curve.parameter
    return [
        Curve(name=name, x=x, y=100 * curve.mean, look=look, marker="own", width=1.8),
        Curve(name="", x=x, y=100 * curve.low, look=look, width=0.9, hover=False),
    ]


def unstable_chart(statistics: StudyStatistics, names: Mapping[str, str]) -> Chart | None:
    """Part of the loops that are unstable, over the parameters that it changes most with."""
    panels = []
    for name in varying_parameters(statistics):
        marks, span = [], 0.0
        for look, controller, curve in _conditional_curves(statistics, name):
            if curve.unstable.any():
                x, y = curve.parameter, 100 * curve.unstable
                marks.append(Curve(name=controller, x=x, y=y, look=look, marker="own", width=1.8))
                span = max(span, float(np.ptp(curve.unstable)))
        axis = Axis(label="unstable", unit="%", low=0)
        panels.append((span, Panel(x=Axis(label=names[name]), y=axis, marks=tuple(marks))))
    most = sorted((pair for pair in panels if pair[1].marks), key=lambda pair: -pair[0])
    shown = tuple(panel for _, panel in most[:_UNSTABLE_PANELS])
    if not shown:
        return None
    listed = listing_text([panel.x.label for panel in shown])
    return Chart(
        key="unstable",
        title="Where loops are unstable",
        caption=(
            "Part of the loops that are unstable in each group of a parameter, all others as they "
            f"come, over the parameters that it changes most with: {listed}. Controllers that are "
            "stable in every sample are not drawn."
        ),
        alt=f"Part of the loops that are unstable over {listed}.",
        panels=shown,
        columns=min(len(shown), 2),
    )


def map_charts(
    statistics: StudyStatistics,
    found: Sequence[ControllerSamples],
    parameters: Mapping[str, FloatArray],
    names: Mapping[str, str],
) -> tuple[Chart, ...]:
    """Mean Strehl ratio over the two most influential parameters, one chart per controller."""
    charts = []
    for place, (one, each) in enumerate(zip(statistics.sensitivities, found, strict=True)):
        if len(one.ranked) < 2:
            continue
        first, second = (parameter.parameter for parameter in one.ranked[:2])
        kept = each.evaluated
        binned = binned_map(parameters[first][kept], parameters[second][kept], each.strehl[kept])
        low, high = (100 * float(end(binned.mean)) for end in (np.nanmin, np.nanmax))
        mark = Map(
            x=binned.x,
            y=binned.y,
            values=100 * binned.mean,
            label="mean Strehl ratio",
            unit="%",
            low=5 * np.floor(low / 5),
            high=5 * np.floor(high / 5) + 5,
            blank="no sample",
        )
        charts.append(
            Chart(
                key=f"map-{place + 1}",
                title=f"{each.controller}: Strehl ratio over {names[first]} and {names[second]}",
                caption=(
                    f"Mean of the Strehl ratio of {each.controller} in each cell, all other "
                    "parameters as they come; unstable loops count as 0. These two parameters have "
                    "its greatest indices; the outermost cells hold what is beyond. The scale of "
                    "colours is its own."
                ),
                alt=(
                    f"Map of the mean Strehl ratio of {each.controller} over {first} and {second}: "
                    f"from {low:.1f} to {high:.1f} %."
                ),
                panels=(
                    Panel(x=Axis(label=names[first]), y=Axis(label=names[second]), marks=(mark,)),
                ),
            )
        )
    return tuple(charts)


def _median_text(each: ControllerSamples) -> str:
    values = each.strehl[each.evaluated]
    if not values.size:
        return f"{each.controller} has none"
    return f"{each.controller} has a median of {100 * np.median(values):.1f} %"


def _strongest_text(statistics: StudyStatistics, place: int) -> str:
    one = statistics.sensitivities[place]
    if not one.ranked:
        return f"{one.controller} has none"
    first = one.ranked[0]
    return f"{one.controller} depends most on {first.parameter}, {100 * first.index.value:.0f} %"
