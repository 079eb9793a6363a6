"""Statistics of a study as rows of tables, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.study.percentiles import Percentile, Share
from lbt_synth.study.sensitivity import ControllerSensitivity, ParameterSensitivity
from lbt_synth.study.statistics import ControllerStatistics, StudyStatistics


@dataclass(frozen=True, slots=True, kw_only=True)
class StatisticsTable:
    """A table of words: a title, headings with units, rows of cells.

    Attributes
    ----------
    title : str
        What it is.
    headings : tuple of str
        One a column.
    rows : tuple of tuple of str
        The cells.
    """

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def percent(value: float, digits: int = 1) -> str:
    """Return a part as a percentage; a dash where there is none."""
    return "-" if np.isnan(value) else f"{100 * value + 0.0:.{digits}f}"


def with_error(value: float, error: float, *, scale: float = 1.0, digits: int = 3) -> str:
    """Return a number with its standard error; a dash where there is none."""
    if np.isnan(value):
        return "-"
    text = f"{scale * value + 0.0:.{digits}f}"
    return text if np.isnan(error) else f"{text} ± {scale * error:.{digits}f}"


def nanometres(value: float) -> str:
    """Return a residual; "unstable" where it is infinite, a dash where there is none."""
    if np.isnan(value):
        return "-"
    return f"{value:.1f}" if np.isfinite(value) else "unstable"


def interval(low: float, high: float, text: Any = percent) -> str:
    """Return an interval; a dash where it is open."""
    return "-" if np.isnan(low) and np.isnan(high) else f"{text(low)} to {text(high)}"


def strehl_table(statistics: StudyStatistics) -> StatisticsTable:
    """Strehl ratio of each controller: percentiles, mean, stability, the best of each sample.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a controller, in percent.
    """
    ranks = [each.percent for each in statistics.controllers[0].strehl]
    headings = [f"{rank:g} %" for rank in ranks]
    return StatisticsTable(
        title="Strehl ratio [%]: percentiles over the samples",
        headings=("controller", *headings, "mean", "unstable [%]", "failed", "best of all [%]"),
        rows=tuple(
            (
                each.controller,
                *(percent(p.value) for p in each.strehl),
                with_error(each.mean, each.mean_error, scale=100, digits=1),
                percent(each.unstable.value, 2),
                str(each.failed),
                percent(each.loss.best.value),
            )
            for each in statistics.controllers
        ),
    )


def interval_table(statistics: StudyStatistics) -> StatisticsTable:
    """Intervals of the percentiles and of the unstable part.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a controller, in percent.
    """
    chosen = (1.0, 5.0, 50.0)
    return StatisticsTable(
        title="95 % intervals [%], for independent samples",
        headings=("controller", *(f"{p:g} % of Strehl" for p in chosen), "unstable"),
        rows=tuple(
            (
                each.controller,
                *(interval(p.low, p.high) for p in each.strehl if p.percent in chosen),
                interval(each.unstable.low, each.unstable.high, lambda part: percent(part, 2)),
            )
            for each in statistics.controllers
        ),
    )


def level_table(statistics: StudyStatistics) -> StatisticsTable:
    """Part of the samples above levels of the Strehl ratio.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a controller, in percent of its samples.
    """
    levels = list(statistics.controllers[0].above)
    return StatisticsTable(
        title="Samples above a Strehl ratio [%]",
        headings=("controller", *(f"above {100 * level:g} %" for level in levels)),
        rows=tuple(
            (each.controller, *(percent(each.above[level].value) for level in levels))
            for each in statistics.controllers
        ),
    )


def residual_table(statistics: StudyStatistics) -> StatisticsTable:
    """Residual of each controller, and the medians of its parts.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a controller, in nm rms; the parts over the stable loops.
    """
    first = statistics.controllers[0]
    ranks = [each.percent for each in first.residual_nm]
    parts = list(dict.fromkeys(part for each in statistics.controllers for part in each.parts_nm))
    return StatisticsTable(
        title="Residual [nm rms]: percentiles, and the medians of its parts",
        headings=("controller", *(f"{rank:g} %" for rank in ranks), *parts),
        rows=tuple(
            (
                each.controller,
                *(nanometres(p.value) for p in each.residual_nm),
                *(nanometres(each.parts_nm.get(part, np.nan)) for part in parts),
            )
            for each in statistics.controllers
        ),
    )


def comparison_table(statistics: StudyStatistics) -> StatisticsTable:
    """Compare controllers with each other on the same samples.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a pair; differences in points of Strehl ratio, first less second.
    """
    pairs = statistics.comparisons
    ranks = [each.percent for each in pairs[0].difference] if pairs else []
    return StatisticsTable(
        title="Difference of the Strehl ratio on the same samples [points]",
        headings=(
            "first less second",
            "first better [%]",
            "equal [%]",
            "mean",
            *(f"{rank:g} %" for rank in ranks),
        ),
        rows=tuple(
            (
                f"{each.first} - {each.second}",
                _share(each.better),
                _share(each.equal),
                with_error(each.mean, each.mean_error, scale=100, digits=2),
                *(_points(p) for p in each.difference),
            )
            for each in pairs
        ),
    )


def sensitivity_table(statistics: StudyStatistics) -> StatisticsTable:
    """First-order indices of the parameters, one column a controller.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a parameter that varies, in the order of the greatest index; then the sum and
        what is left to interactions.
    """
    found = statistics.sensitivities
    by_name = [{each.parameter: each for each in one.parameters} for one in found]
    return StatisticsTable(
        title="Variance of the Strehl ratio explained by one parameter [%]",
        headings=("parameter", *(one.controller for one in found)),
        rows=(
            *(
                (name, *(_index(names[name]) for names in by_name))
                for name in varying_parameters(statistics)
            ),
            ("sum", *(_sum(one) for one in found)),
            ("only together", *(percent(one.interactions) for one in found)),
        ),
    )


def swing_table(statistics: StudyStatistics) -> StatisticsTable:
    """How far the mean Strehl ratio moves over each parameter, and in which direction.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    StatisticsTable
        One row a parameter that varies; points of Strehl ratio, and the rank correlation in
        brackets.
    """
    found = statistics.sensitivities
    by_name = [{each.parameter: each for each in one.parameters} for one in found]
    return StatisticsTable(
        title="Points of Strehl ratio over the middle 90 % of a parameter (rank correlation)",
        headings=("parameter", *(one.controller for one in found)),
        rows=tuple(
            (name, *(_swing(names[name]) for names in by_name))
            for name in varying_parameters(statistics)
        ),
    )


def worst_table(controller: ControllerStatistics, parameters: Sequence[str]) -> StatisticsTable:
    """List the samples on which a controller does worst.

    Parameters
    ----------
    controller : ControllerStatistics
        The controller.
    parameters : sequence of str
        Parameters to list.

    Returns
    -------
    StatisticsTable
        One row a sample.
    """
    return StatisticsTable(
        title=f"Worst samples of {controller.controller}",
        headings=("row", "Strehl [%]", "residual [nm]", *parameters),
        rows=tuple(
            (
                str(each.row),
                percent(each.strehl) if each.stable else "unstable",
                nanometres(each.residual_nm) if each.stable else "-",
                *(f"{each.parameters[name]:.5g}" for name in parameters),
            )
            for each in controller.worst
        ),
    )


def summary_tables(statistics: StudyStatistics) -> tuple[StatisticsTable, ...]:
    """Tables of a study: percentiles, intervals, levels, residuals, comparison, sensitivity.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    tuple of StatisticsTable
        Those that have rows; the worst samples are in :func:`worst_table`.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> from lbt_synth.study.summary import summary_tables
    >>> gain = np.linspace(0.5, 1.5, 201)
    >>> columns = {"gain": gain, "a.stable": np.ones(201), "a.residual_nm": 100 / gain,
    ...            "a.strehl": 0.5 * gain}
    >>> first, *others = summary_tables(lbt.study_statistics(columns, ["gain"], ["a"]))
    >>> first.headings[4], first.rows[0][4]
    ('50 %', '50.0')
    """
    tables = (
        strehl_table(statistics),
        interval_table(statistics),
        level_table(statistics),
        residual_table(statistics),
        comparison_table(statistics),
        sensitivity_table(statistics),
        swing_table(statistics),
    )
    return tuple(table for table in tables if table.rows and len(table.headings) > 1)


def varying_parameters(statistics: StudyStatistics) -> tuple[str, ...]:
    """Parameters with an index for any controller, in order of the greatest."""
    greatest: dict[str, float] = {}
    for one in statistics.sensitivities:
        for each in one.ranked:
            value = each.index.value
            greatest[each.parameter] = max(greatest.get(each.parameter, -np.inf), value)
    return tuple(sorted(greatest, key=lambda name: -greatest[name]))


def _share(part: Share) -> str:
    return percent(part.value)


def _points(difference: Percentile) -> str:
    return "-" if np.isnan(difference.value) else f"{100 * difference.value + 0.0:+.1f}"


def _index(one: ParameterSensitivity) -> str:
    return with_error(one.index.value, one.index.error, scale=100, digits=1)


def _sum(one: ControllerSensitivity) -> str:
    return with_error(one.sum, one.sum_error, scale=100, digits=1)


def _swing(one: ParameterSensitivity) -> str:
    if np.isnan(one.swing):
        return "-"
    sign = "-" if np.isnan(one.spearman) else f"{one.spearman:+.2f}"
    return f"{with_error(one.swing, one.swing_error, scale=100, digits=1)} ({sign})"
