"""Tables of a study's statistics, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.storage.display_unit import shown_format, shown_unit
from lbt_synth.storage.rows import cell_text
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.studies.study.statistics import (
    PERCENTS,
    ControllerStatistics,
    Interval,
    StudyStatistics,
)

_Row = tuple[str | Cell, ...]  # a label and a cell for each controller, or a heading alone


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
    kinds = (strehl_table, residual_table, comparison_table, sensitivity_table)
    return tuple(table for kind in kinds if (table := kind(statistics)).rows)


def strehl_table(statistics: StudyStatistics) -> Table:
    """Strehl ratio of each controller: mean, percentiles, parts of the samples."""
    controllers = statistics.controllers
    rows: list[_Row] = [
        (
            "mean ± standard error",
            *(_with_error(c.mean, c.mean_error, digits=2) for c in controllers),
        ),
        *((ordinal(p), *(_interval(c.strehl[p]) for c in controllers)) for p in PERCENTS),
        ("part of the samples [%]",),
        *(
            (f"above {100 * level:g} %", *(_interval(c.above[level]) for c in controllers))
            for level in controllers[0].above
        ),
        (
            "unstable, counted as 0",
            *(_bad_if(c.unstable, _interval(c.unstable_share, digits=2)) for c in controllers),
        ),
        ("best of all controllers", *(_interval(c.best) for c in controllers)),
        ("samples",),
        ("evaluated", *(str(c.samples) for c in controllers)),
        ("failed", *(_bad_if(c.failed, str(c.failed)) for c in controllers)),
    ]
    caption = "Strehl ratio over the samples, with 95 % intervals for independent samples"
    return _table_by_controller(caption, "of the Strehl ratio [%]", statistics, rows)


def residual_table(statistics: StudyStatistics) -> Table:
    """Residual of each controller, and the medians of its parts."""
    controllers = statistics.controllers
    parts = dict.fromkeys(part for c in controllers for part in c.parts_nm)
    unit, factor = shown_unit("nm rms")

    def text(residual_nm: float) -> str:
        if np.isinf(residual_nm):
            return "unstable"
        return cell_text(residual_nm * factor, shown_format(".1f", factor))

    rows: list[_Row] = [
        *((ordinal(p), *(text(c.residual_nm[p].value) for c in controllers)) for p in PERCENTS),
        *([("median over the stable loops",)] if parts else []),
        *((f"of {p}", *(text(c.parts_nm.get(p, np.nan)) for c in controllers)) for p in parts),
    ]
    caption = "Residual of tip and tilt over the samples"
    return _table_by_controller(caption, f"residual [{unit}]", statistics, rows)


def comparison_table(statistics: StudyStatistics) -> Table:
    """Compare controllers with each other on the same samples."""
    points = ("5th percentile", "median", "95th percentile")
    return Table(
        caption="Strehl ratio on the same samples: first less second [points]",
        headings=("pair", "first better [%]", "equal [%]", "mean", *points),
        rows=tuple(
            (
                pair,
                percent(row["better"]),
                percent(row["equal"]),
                _with_error(row["mean"], row["mean_error"], digits=2),
                *(cell_text(100 * row[point], "+.1f") for point in points),
            )
            for pair, row in statistics.comparisons.items()
        ),
    )


def sensitivity_table(
    statistics: StudyStatistics, *, names: Mapping[str, str] | None = None
) -> Table:
    """First-order indices of the parameters with their signs, one column per controller."""
    controllers, words = statistics.controllers, names or {}
    totals: list[list[str]] = [[], []]
    for controller in controllers:
        ranked = [controller.sensitivity[name] for name in controller.ranked]
        total = float(np.sum([row["index"] for row in ranked])) if ranked else np.nan
        error = float(np.linalg.norm([row["index_error"] for row in ranked]))
        for texts, value in zip(totals, (total, 1 - total), strict=True):
            texts.append(_with_error(value, error))
    rows: list[_Row] = [
        (words.get(name, name), *(_share_text(c.sensitivity[name]) for c in controllers))
        for name in statistics.ranked
    ]
    if rows:
        labels = ("sum", "only together (interactions)")
        rows.append(("all of them",))
        rows += [(label, *texts) for label, texts in zip(labels, totals, strict=True)]
    caption = "Variance of the Strehl ratio that one parameter explains by itself [%]"
    return _table_by_controller(f"{caption} (rank correlation)", "parameter", statistics, rows)


def _share_text(row: Mapping[str, float]) -> str:
    """Return the part that a parameter explains, and the sign of its effect."""
    text = _with_error(row["index"], row["index_error"])
    return text if text == "-" else f"{text} ({cell_text(row['spearman'], '+.2f')})"


def worst_table(
    controller: ControllerStatistics,
    columns: Mapping[str, ArrayLike],
    parameters: Sequence[str],
    *,
    names: Mapping[str, str] | None = None,
) -> Table:
    """List the samples on which a controller does worst, from the columns of the results."""
    places, name = list(controller.worst), controller.controller

    def at(column: str) -> list[float]:
        return [float(value) for value in np.asarray(columns[column], dtype=np.float64)[places]]

    rows = [f"{row:.0f}" for row in at("row")] if "row" in columns else [str(i) for i in places]
    strehls: list[str | Cell] = [
        percent(strehl) if stable else Cell(text="unstable", tone="bad")
        for strehl, stable in zip(at(f"{name}.strehl"), at(f"{name}.stable"), strict=True)
    ]
    values = [[f"{value:.5g}" for value in at(parameter)] for parameter in parameters]
    return Table(
        caption=f"Worst samples of {name}",
        headings=("row", "Strehl [%]", *((names or {}).get(each, each) for each in parameters)),
        rows=tuple(zip(rows, strehls, *values, strict=True)),
    )


def percent(value: float, digits: int = 1) -> str:
    """Return a part as a percentage, a dash if it is nan."""
    return cell_text(100 * value, f".{digits}f")


def ordinal(percentile: float) -> str:
    """Return the name of one of the percentiles."""
    return f"{percentile:g}{'st' if percentile == 1 else 'th'} percentile"


def _table_by_controller(
    caption: str, heading: str, statistics: StudyStatistics, rows: Sequence[_Row]
) -> Table:
    """Return a table with a column per controller."""
    headings = (heading, *(each.controller for each in statistics.controllers))
    return Table(caption=caption, headings=headings, rows=tuple(rows))


def _with_error(value: float, error: float, digits: int = 1) -> str:
    """Return a part with its standard error as percentages, a dash if it is nan."""
    text = percent(value, digits)
    return text if text == "-" or np.isnan(error) else f"{text} ± {percent(error, digits)}"


def _interval(interval: Interval, digits: int = 1) -> str:
    """Return a percentage and the limits of its interval that there are."""
    numbers = interval.value, interval.low, interval.high
    text, low, high = (percent(number, digits) for number in numbers)
    if low == high == "-":
        return text
    if "-" in (low, high):
        return f"{text} (to {high})" if low == "-" else f"{text} (from {low})"
    return f"{text} ({low} to {high})"


def _bad_if(count: int, text: str) -> str | Cell:
    """Return a text, marked as bad if it counts any."""
    return Cell(text=text, tone="bad") if count else text
