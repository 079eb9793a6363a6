"""Tables of a study's statistics, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from lbt_synth.storage.display_unit import shown_format, shown_unit
from lbt_synth.storage.rows import cell_text
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies.study.percentiles import Percentile, Share
from lbt_synth.studies.study.sensitivity import ControllerSensitivity
from lbt_synth.studies.study.statistics import ControllerStatistics, StudyStatistics

_Row = tuple[str, Callable[[Any], str | Cell] | None]  # a label, and the text of a controller


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
    kinds = (strehl_table, residual_table, comparison_table, sensitivity_table, swing_table)
    return tuple(table for kind in kinds if (table := kind(statistics)).rows)


def strehl_table(statistics: StudyStatistics) -> Table:
    """Strehl ratio of each controller: mean, percentiles, parts of the samples."""
    first = statistics.controllers[0]
    return _table_by_controller(
        "Strehl ratio over the samples, with 95 % intervals for independent samples",
        "of the Strehl ratio [%]",
        statistics.controllers,
        (
            ("mean ± standard error", lambda c: _with_error(c.mean, c.mean_error, digits=2)),
            *(
                (ordinal(each.percent), lambda c, i=i: _interval(c.strehl[i]))
                for i, each in enumerate(first.strehl)
            ),
            ("part of the samples [%]", None),
            *(
                (f"above {100 * level:g} %", lambda c, level=level: _interval(c.above[level]))
                for level in first.above
            ),
            (
                "unstable, counted as 0",
                lambda c: _bad_if(c.unstable.count, _interval(c.unstable, digits=2)),
            ),
            ("best of all controllers", lambda c: _interval(c.loss.best)),
            ("samples", None),
            ("evaluated", lambda c: str(c.samples)),
            ("failed", lambda c: _bad_if(c.failed, str(c.failed))),
        ),
    )


def residual_table(statistics: StudyStatistics) -> Table:
    """Residual of each controller, and the medians of its parts."""
    found = statistics.controllers
    parts = dict.fromkeys(part for c in found for part in c.parts_nm)
    unit, factor = shown_unit("nm rms")

    def text(residual_nm: float) -> str:
        if np.isinf(residual_nm):
            return "unstable"
        return cell_text(residual_nm * factor, shown_format(".1f", factor))

    return _table_by_controller(
        "Residual of tip and tilt over the samples",
        f"residual [{unit}]",
        found,
        (
            *(
                (ordinal(each.percent), lambda c, i=i: text(c.residual_nm[i].value))
                for i, each in enumerate(found[0].residual_nm)
            ),
            *([("median over the stable loops", None)] if parts else []),
            *(
                (f"of {part}", lambda c, part=part: text(c.parts_nm.get(part, np.nan)))
                for part in parts
            ),
        ),
    )


def comparison_table(statistics: StudyStatistics) -> Table:
    """Compare controllers with each other on the same samples."""
    percents = (5, 50, 95)
    return Table(
        caption="Strehl ratio on the same samples: first less second [points]",
        headings=(
            "pair",
            "first better [%]",
            "equal [%]",
            "mean",
            *("median" if each == 50 else ordinal(each) for each in percents),
        ),
        rows=tuple(
            (
                f"{pair.first} less {pair.second}",
                percent(pair.better.value),
                percent(pair.equal.value),
                _with_error(pair.mean, pair.mean_error, digits=2),
                *(
                    cell_text(100 * each.value, "+.1f")
                    for each in pair.difference
                    if each.percent in percents
                ),
            )
            for pair in statistics.comparisons
        ),
    )


def sensitivity_table(
    statistics: StudyStatistics, *, names: Mapping[str, str] | None = None
) -> Table:
    """First-order indices of the parameters, one column per controller."""
    indices = list(_rows_by_parameter(statistics, _index_text, names))
    totals: list[_Row] = [
        ("all of them", None),
        ("sum", lambda s: _with_error(s.sum, s.sum_error)),
        ("only together (interactions)", lambda s: _with_error(s.interactions, s.sum_error)),
    ]
    return _table_by_controller(
        "Variance of the Strehl ratio that one parameter explains by itself [%]",
        "parameter",
        statistics.sensitivities,
        [*indices, *totals] if indices else [],
    )


def swing_table(statistics: StudyStatistics, *, names: Mapping[str, str] | None = None) -> Table:
    """How far the mean Strehl ratio moves over each parameter, and in which direction."""
    return _table_by_controller(
        "Points of Strehl ratio over the middle 90 % of a parameter (rank correlation)",
        "parameter",
        statistics.sensitivities,
        _rows_by_parameter(statistics, _swing_text, names),
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
    found = [each for one in statistics.sensitivities for each in one.ranked]
    found.sort(key=lambda each: -each.index.value)
    return tuple(dict.fromkeys(each.parameter for each in found))


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return for each path its last keys, as many as distinguish it from the others."""
    out = {}
    for name in names:
        keys = name.split(".")
        for count in range(1, len(keys) + 1):
            out[name] = ".".join(keys[-count:])
            if sum(f".{other}".endswith(f".{out[name]}") for other in names) == 1:
                break
    return out


def percent(value: float, digits: int = 1) -> str:
    """Return a part as a percentage, a dash if it is nan."""
    return cell_text(100 * value, f".{digits}f")


def ordinal(percentile: float) -> str:
    """Return the name of a percentile."""
    suffix = {1: "st", 2: "nd", 3: "rd"}.get(int(percentile) % 10, "th")
    teens = 10 < percentile % 100 < 14
    return f"{percentile:g}{'th' if teens or percentile % 1 else suffix} percentile"


def _table_by_controller(
    caption: str,
    heading: str,
    found: Sequence[ControllerStatistics | ControllerSensitivity],
    rows: Iterable[_Row],
) -> Table:
    """Return a table with a column per controller; a row without texts is a heading."""
    headings = (heading, *(each.controller for each in found))
    lines = tuple((label, *(map(text, found) if text else ())) for label, text in rows)
    return Table(caption=caption, headings=headings, rows=lines)


def _rows_by_parameter(
    statistics: StudyStatistics,
    text: Callable[[str, ControllerSensitivity], str],
    names: Mapping[str, str] | None,
) -> Iterator[_Row]:
    """Yield a row per varying parameter."""
    for name in varying_parameters(statistics):
        yield (names or {}).get(name, name), partial(text, name)


def _index_text(name: str, one: ControllerSensitivity) -> str:
    index = one.find(name).index
    return _with_error(index.value, index.error)


def _swing_text(name: str, one: ControllerSensitivity) -> str:
    found = one.find(name)
    if np.isnan(found.swing):
        return "-"
    return f"{_with_error(found.swing, found.swing_error)} ({cell_text(found.spearman, '+.2f')})"


def _with_error(value: float, error: float, digits: int = 1) -> str:
    """Return a part with its standard error as percentages, a dash if it is nan."""
    text = percent(value, digits)
    return text if text == "-" or np.isnan(error) else f"{text} ± {percent(error, digits)}"


def _interval(found: Percentile | Share, digits: int = 1) -> str:
    """Return a percentage and the limits of its interval that there are."""
    text, low, high = (percent(each, digits) for each in (found.value, found.low, found.high))
    if low == high == "-":
        return text
    if "-" in (low, high):
        return f"{text} (to {high})" if low == "-" else f"{text} (from {low})"
    return f"{text} ({low} to {high})"


def _bad_if(count: int, text: str) -> str | Cell:
    """Return a text, marked as bad if it counts any."""
    return Cell(text=text, tone="bad") if count else text
