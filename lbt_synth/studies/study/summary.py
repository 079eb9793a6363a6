"""Tables of a study's statistics, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies.study.percentiles import Percentile, Share
from lbt_synth.studies.study.sensitivity import ParameterSensitivity
from lbt_synth.studies.study.statistics import ControllerStatistics, StudyStatistics

Row = tuple[str | Cell, ...]


def summary_tables(statistics: StudyStatistics) -> tuple[Table, ...]:
    """Tables of a study: Strehl ratios, residuals, comparison, what they depend on.

    Parameters
    ----------
    statistics : StudyStatistics
        The study.

    Returns
    -------
    tuple of Table
        Those that have rows; :func:`worst_table` lists the worst samples.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> gain = np.linspace(0.5, 1.5, 201)
    >>> columns = {
    ...     "gain": gain,
    ...     "a.stable": np.ones(201),
    ...     "a.residual_nm": 100 / gain,
    ...     "a.strehl": 0.5 * gain,
    ... }
    >>> first, *others = lbt.studies.summary_tables(
    ...     lbt.studies.study_statistics(columns, ["gain"], ["a"])
    ... )
    >>> first.headings, first.rows[4]
    (('of the Strehl ratio [%]', 'a'), ('50th percentile', '50.0 (46.5 to 53.5)'))
    """
    tables = (
        strehl_table(statistics),
        residual_table(statistics),
        comparison_table(statistics),
        sensitivity_table(statistics),
        swing_table(statistics),
    )
    return tuple(table for table in tables if table.rows)


def strehl_table(statistics: StudyStatistics) -> Table:
    """Strehl ratio of each controller: mean, percentiles, parts of the samples."""
    found = statistics.controllers
    first = found[0]
    return Table(
        caption="Strehl ratio over the samples, with 95 % intervals for independent samples",
        headings=("of the Strehl ratio [%]", *(c.controller for c in found)),
        rows=(
            (
                "mean ± standard error",
                *(with_error(c.mean, c.mean_error, scale=100, digits=2) for c in found),
            ),
            *(
                (ordinal(each.percent), *(_percentile(c.strehl[i]) for c in found))
                for i, each in enumerate(first.strehl)
            ),
            ("part of the samples [%]",),
            *(
                (f"above {100 * level:g} %", *(_share(c.above[level]) for c in found))
                for level in first.above
            ),
            ("unstable, counted as 0", *(_unstable(c.unstable) for c in found)),
            ("best of all controllers", *(_share(c.loss.best) for c in found)),
            ("samples",),
            ("evaluated", *(str(c.samples) for c in found)),
            ("failed", *(_bad_if(c.failed, str(c.failed)) for c in found)),
        ),
    )


def residual_table(statistics: StudyStatistics) -> Table:
    """Residual of each controller, and the medians of its parts."""
    found = statistics.controllers
    rows: list[Row] = [
        (ordinal(each.percent), *(nanometres(c.residual_nm[i].value) for c in found))
        for i, each in enumerate(found[0].residual_nm)
    ]
    parts = dict.fromkeys(part for c in found for part in c.parts_nm)
    if parts:
        rows.append(("median over the stable loops",))
        rows.extend(
            (f"of {part}", *(nanometres(c.parts_nm.get(part, np.nan)) for c in found))
            for part in parts
        )
    return Table(
        caption="Residual of tip and tilt over the samples",
        headings=("residual [nm rms]", *(c.controller for c in found)),
        rows=tuple(rows),
    )


def comparison_table(statistics: StudyStatistics) -> Table:
    """Compare controllers with each other on the same samples."""
    return Table(
        caption="Strehl ratio on the same samples: first less second [points]",
        headings=(
            "pair",
            "first better [%]",
            "equal [%]",
            "mean",
            "5th percentile",
            "median",
            "95th percentile",
        ),
        rows=tuple(
            (
                f"{pair.first} less {pair.second}",
                percent(pair.better.value),
                percent(pair.equal.value),
                with_error(pair.mean, pair.mean_error, scale=100, digits=2),
                *(_points(d) for d in pair.difference if d.percent in (5, 50, 95)),
            )
            for pair in statistics.comparisons
        ),
    )


def sensitivity_table(
    statistics: StudyStatistics, *, names: Mapping[str, str] | None = None
) -> Table:
    """First-order indices of the parameters, one column per controller."""
    found = statistics.sensitivities
    rows = _by_parameter(statistics, _index, names)
    if rows:
        rows += [
            ("all of them",),
            ("sum", *(with_error(s.sum, s.sum_error, scale=100, digits=1) for s in found)),
            (
                "only together (interactions)",
                *(with_error(s.interactions, s.sum_error, scale=100, digits=1) for s in found),
            ),
        ]
    return Table(
        caption="Variance of the Strehl ratio that one parameter explains by itself [%]",
        headings=("parameter", *(s.controller for s in found)),
        rows=tuple(rows),
    )


def swing_table(statistics: StudyStatistics, *, names: Mapping[str, str] | None = None) -> Table:
    """How far the mean Strehl ratio moves over each parameter, and in which direction."""
    return Table(
        caption="Points of Strehl ratio over the middle 90 % of a parameter (rank correlation)",
        headings=("parameter", *(s.controller for s in statistics.sensitivities)),
        rows=tuple(_by_parameter(statistics, _swing, names)),
    )


def worst_table(
    controller: ControllerStatistics,
    parameters: Sequence[str],
    *,
    names: Mapping[str, str] | None = None,
) -> Table:
    """List the samples on which a controller does worst."""
    return Table(
        caption=f"Worst samples of {controller.controller}",
        headings=("row", "Strehl [%]", *((names or {}).get(name, name) for name in parameters)),
        rows=tuple(
            (
                str(each.row),
                percent(each.strehl) if each.stable else Cell(text="unstable", tone="bad"),
                *(f"{each.parameters[name]:.5g}" for name in parameters),
            )
            for each in controller.worst
        ),
    )


def varying_parameters(statistics: StudyStatistics) -> tuple[str, ...]:
    """Return the parameters with an index for any controller, by falling greatest index."""
    greatest: dict[str, float] = {}
    for one in statistics.sensitivities:
        for each in one.ranked:
            value = each.index.value
            greatest[each.parameter] = max(greatest.get(each.parameter, -np.inf), value)
    return tuple(sorted(greatest, key=lambda name: -greatest[name]))


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return for each path its last keys, as many as distinguish it from the others.

    Examples
    --------
    >>> from lbt_synth.studies.study.summary import short_names
    >>> found = short_names(
    ...     ["truth.vibrations[0].rms_mas", "truth.vibrations[1].rms_mas", "truth.sensor_gain"]
    ... )
    >>> list(found.values())
    ['vibrations[0].rms_mas', 'vibrations[1].rms_mas', 'sensor_gain']
    """
    out = {}
    for name in names:
        keys = name.split(".")
        for count in range(1, len(keys) + 1):
            short = ".".join(keys[-count:])
            if sum(other == short or other.endswith(f".{short}") for other in names) == 1:
                break
        out[name] = short
    return out


def percent(value: float, digits: int = 1) -> str:
    """Return a part as a percentage, a dash if it is nan."""
    return "-" if np.isnan(value) else _number(100 * value, digits)


def with_error(value: float, error: float, *, scale: float = 1.0, digits: int = 3) -> str:
    """Return a number with its standard error, a dash if it is nan."""
    if np.isnan(value):
        return "-"
    text = _number(scale * value, digits)
    return text if np.isnan(error) else f"{text} ± {_number(scale * error, digits)}"


def nanometres(value: float) -> str:
    """Return a residual: "unstable" if it is infinite, a dash if it is nan."""
    if np.isnan(value):
        return "-"
    return _number(value, 1) if np.isfinite(value) else "unstable"


def ordinal(percentile: float) -> str:
    """Return the name of a percentile.

    Examples
    --------
    >>> from lbt_synth.studies.study.summary import ordinal
    >>> ordinal(1), ordinal(95)
    ('1st percentile', '95th percentile')
    """
    suffix = {1: "st", 2: "nd", 3: "rd"}.get(int(percentile) % 10, "th")
    teens = 10 < percentile % 100 < 14
    return f"{percentile:g}{'th' if teens or percentile % 1 else suffix} percentile"


def _number(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _range(text: str, low: float, high: float, digits: int) -> str:
    """Return a value and the limits of its interval that there are [percent]."""
    if np.isnan(low) and np.isnan(high):
        return text
    if np.isnan(low):
        return f"{text} (to {percent(high, digits)})"
    if np.isnan(high):
        return f"{text} (from {percent(low, digits)})"
    return f"{text} ({percent(low, digits)} to {percent(high, digits)})"


def _percentile(found: Percentile) -> str:
    return _range(percent(found.value), found.low, found.high, 1)


def _share(part: Share, digits: int = 1) -> str:
    return _range(percent(part.value, digits), part.low, part.high, digits)


def _unstable(part: Share) -> str | Cell:
    return _bad_if(part.count, _share(part, 2))


def _bad_if(count: int, text: str) -> str | Cell:
    """Return a text, marked as bad if it counts any."""
    return Cell(text=text, tone="bad") if count else text


def _points(difference: Percentile) -> str:
    value = round(100 * difference.value, 1) + 0.0
    return "-" if np.isnan(value) else f"{value:+.1f}"


def _by_parameter(
    statistics: StudyStatistics,
    text: Callable[[ParameterSensitivity], str],
    names: Mapping[str, str] | None,
) -> list[Row]:
    """Return a row per varying parameter, with a column per controller."""
    found = [{p.parameter: p for p in one.parameters} for one in statistics.sensitivities]
    return [
        ((names or {}).get(name, name), *(text(by_name[name]) for by_name in found))
        for name in varying_parameters(statistics)
    ]


def _index(one: ParameterSensitivity) -> str:
    return with_error(one.index.value, one.index.error, scale=100, digits=1)


def _swing(one: ParameterSensitivity) -> str:
    if np.isnan(one.swing):
        return "-"
    sign = "-" if np.isnan(one.spearman) else f"{one.spearman:+.2f}"
    return f"{with_error(one.swing, one.swing_error, scale=100, digits=1)} ({sign})"
