"""Statistics of a study and their tables: percentiles, and what the Strehl ratio depends on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.storage.display_unit import shown_format, shown_unit
from lbt_synth.storage.rows import cell_text
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.validation import BoolArray, FloatArray

PERCENTS = (1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0)
CONFIDENCE = 0.95  # of the interval of a percentile or a share
_MOST_WORST = 10  # samples that are listed
_FEWEST = 20  # samples for an index
_CONSTANT = 1e-12  # scatter of a Strehl ratio that is rounding
# With more pieces than 8 and fewer samples, one parameter of a Sobol sequence inherits up to 9 % of
# another
_FEW_GROUPS, _MANY_SAMPLES = 8, 4096
_MOST_VALUES = 32  # a parameter with more distinct values is continuous

_INDEX = ("index", "index_error")
Samples = dict[str, Any]  # columns (n,) of one controller
_Row = tuple[str | Cell, ...]  # a label and a cell for each controller, or a heading alone


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A percentile or a share of samples, with the 95 % interval of the true one."""

    value: float  # nan if there is no sample
    low: float  # nan if the sample is too small for a limit
    high: float


_NONE = Interval(value=np.nan, low=np.nan, high=np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerStatistics:
    """Statistics of one controller over all samples."""

    controller: str  # its name
    samples: int  # samples on which it was evaluated
    failed: int  # samples on which the evaluation failed; all that follows leaves them out
    # loops that are unstable. Their Strehl ratio counts as 0, their residual as infinite
    unstable: int
    unstable_share: Interval
    mean: float  # mean of the Strehl ratio, and its standard error for independent samples
    mean_error: float
    strehl: dict[float, Interval]  # percentiles of the Strehl ratio
    residual_nm: dict[float, Interval]  # percentiles of the residual [nm rms]
    worst: tuple[int, ...]  # places of the samples on which it does worst, the worst first
    # for each parameter: index, the part of the variance that it explains by itself, and
    # index_error, its standard error; nan for a constant
    sensitivity: dict[str, dict[str, float]]

    @property
    def ranked(self) -> tuple[str, ...]:
        """The parameters that vary, by falling index."""
        varying = (n for n, row in self.sensitivity.items() if np.isfinite(row["index"]))
        return tuple(sorted(varying, key=lambda name: -self.sensitivity[name]["index"]))

    def index(self, name: str) -> tuple[float, float]:
        """Return the index of a parameter and its standard error."""
        return self.sensitivity[name]["index"], self.sensitivity[name]["index_error"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyStatistics:
    """Statistics of a study."""

    samples: int  # samples in the study so far
    parameters: tuple[str, ...]  # their names
    controllers: tuple[ControllerStatistics, ...]  # each controller by itself

    @property
    def ranked(self) -> tuple[str, ...]:
        """The parameters with an index for any controller, by falling greatest index."""
        pairs = [(one.index(name)[0], name) for one in self.controllers for name in one.ranked]
        return tuple(dict.fromkeys(name for _, name in sorted(pairs, key=lambda pair: -pair[0])))


def study_statistics(
    columns: Mapping[str, ArrayLike], parameters: Sequence[str], controllers: Sequence[str]
) -> StudyStatistics:
    """Compute the statistics of a study's results (n,), by the names of its columns.

    An unstable loop counts as a Strehl ratio of 0; failed evaluations are left out and counted.
    """
    values = {name: np.asarray(columns[name], dtype=np.float64) for name in parameters}
    rows = np.asarray(columns["row"])
    return StudyStatistics(
        samples=len(rows),
        parameters=tuple(parameters),
        controllers=tuple(
            _controller_statistics(name, controller_samples(columns, name), rows, values)
            for name in controllers
        ),
    )


def _controller_statistics(
    controller: str,
    samples: Samples,
    rows: FloatArray,
    values: Mapping[str, FloatArray],
) -> ControllerStatistics:
    places = np.flatnonzero(samples["evaluated"])
    strehl, unstable = samples["strehl"][places], samples["unstable"][places]
    n = len(strehl)
    worst = places[np.lexsort((rows[places], strehl, ~unstable))[:_MOST_WORST]]
    return ControllerStatistics(
        controller=controller,
        samples=n,
        failed=len(samples["strehl"]) - n,
        unstable=int(np.count_nonzero(unstable)),
        unstable_share=share(unstable),
        mean=float(np.mean(strehl)) if n else np.nan,
        mean_error=float(np.std(strehl, ddof=1)) / n**0.5 if n > 1 else np.nan,
        strehl=percentiles(strehl, PERCENTS),
        residual_nm=percentiles(samples["residual_nm"][places], PERCENTS),
        worst=tuple(worst.tolist()),
        sensitivity={
            name: dict(zip(_INDEX, first_order_index(numbers[places], strehl), strict=True))
            for name, numbers in values.items()
        },
    )


def controller_samples(columns: Mapping[str, ArrayLike], controller: str) -> Samples:
    """Return the columns of a controller, (n,) each: results, and what was evaluated and unstable.

    An unstable loop has a Strehl ratio of 0 and an infinite residual, a failed evaluation has nan.
    """
    mark, strehl, residual_nm = (
        np.asarray(columns[f"{controller}.{name}"], dtype=np.float64)
        for name in ("stable", "strehl", "residual_nm")
    )
    return {
        "strehl": np.where(mark == 0, 0.0, strehl),
        "residual_nm": np.where(mark == 0, np.inf, residual_nm),
        "evaluated": ~np.isnan(mark),
        "unstable": mark == 0,
    }


def percentiles(values: FloatArray, percents: Sequence[float]) -> dict[float, Interval]:
    """Return percentiles of a sample (n,), with intervals from order statistics."""
    from scipy.stats import quantile_test

    if len(values) == 0:
        return dict.fromkeys(percents, _NONE)
    ordered, intervals = np.sort(values), {}
    places = np.array(percents) / 100 * (len(ordered) - 1)
    quantiles = np.interp(places, np.arange(len(ordered)), ordered)  # some may be infinite
    for percent, value in zip(percents, quantiles.tolist(), strict=True):
        ends: Any = quantile_test(ordered, q=0, p=percent / 100).confidence_interval(CONFIDENCE)
        intervals[percent] = Interval(value=value, low=float(ends.low), high=float(ends.high))
    return intervals


def share(where: BoolArray) -> Interval:
    """Return the part of the samples (n,) of a mask, with the interval of Clopper and Pearson."""
    from scipy.stats import binomtest

    if len(where) == 0:
        return _NONE
    count = int(np.count_nonzero(where))
    ends = binomtest(count, len(where)).proportion_ci(CONFIDENCE, method="exact")
    return Interval(value=count / len(where), low=float(ends.low), high=float(ends.high))


def first_order_index(parameter: FloatArray, result: FloatArray) -> tuple[float, float]:
    """Return ``Var(E[y | x]) / Var(y)`` of a result y (n,) for a parameter x (n,).

    Its standard error comes with it; both are nan if the result or the parameter is constant, or
    of few samples. The mean given x is one value for each of a list, else a quadratic spline over
    the rank, in n^(1/3) pieces or in 8 of them below 4096 samples.
    """
    from scipy.interpolate import make_lsq_spline
    from scipy.stats import rankdata

    n = len(parameter)
    if n < _FEWEST or np.ptp(parameter) == 0 or np.std(result) <= _CONSTANT:
        return np.nan, np.nan
    spread = result - np.mean(result)
    total = float(spread @ spread)
    _, group, counts = np.unique(parameter, return_inverse=True, return_counts=True)
    if len(counts) <= min(_MOST_VALUES, max(2, n // 5)):
        coefficients = len(counts)
        fit = (np.bincount(group, spread) / counts)[group]
    else:
        pieces = max(_FEW_GROUPS, round(n ** (1 / 3)) if n >= _MANY_SAMPLES else 0)
        order, ranks = np.argsort(parameter), rankdata(parameter)
        joints = np.linspace(ranks.min(), ranks.max(), pieces + 1)
        knots = np.pad(joints, 2, mode="edge")
        coefficients = pieces + 2
        fit = make_lsq_spline(ranks[order], spread[order], knots, 2)(ranks)
    squares = (spread - fit) ** 2
    unexplained = float(np.sum(squares)) / total
    # a fit follows some of the scatter (T. L. Kelley, Proc. Natl. Acad. Sci. 21, 554 (1935))
    correction = (coefficients - 1) * unexplained / (n - coefficients)
    # what a sample adds to the index, to first order; at least the error of an index of 0
    influence = (squares - unexplained * spread * spread) * (n / total)
    least = unexplained * (2 * (coefficients - 1)) ** 0.5 / n
    return 1 - unexplained - correction, max(float(np.std(influence)) / n**0.5, least)


def controller_table(statistics: StudyStatistics) -> Table:
    """Return a line for each controller."""
    kinds = ("mean", "+-", "5th", "median", "95th", "unstable")
    rows = []
    for one in statistics.controllers:
        low, median, high = (one.strehl[p].value for p in (5, 50, 95))
        values = (one.mean, one.mean_error, low, median, high, one.unstable_share.value)
        rows.append((one.controller, *(percent(value, 2) for value in values), str(one.failed)))
    return Table(
        caption="Strehl ratio over the samples, with percentiles; an unstable loop counts as 0",
        headings=("controller", *(f"{kind} [%]" for kind in kinds), "failed"),
        rows=tuple(rows),
    )


def summary_tables(statistics: StudyStatistics) -> tuple[Table, ...]:
    """Return the tables of a study that have rows: Strehl ratios, residuals, dependence."""
    kinds = (strehl_table, residual_table, sensitivity_table)
    return tuple(table for kind in kinds if (table := kind(statistics)).rows)


def strehl_table(statistics: StudyStatistics) -> Table:
    """Strehl ratio of each controller: mean, percentiles, and how many loops are unstable."""
    controllers = statistics.controllers
    rows: list[_Row] = [
        ("mean ± standard error", *(_with_error(c.mean, c.mean_error, 2) for c in controllers)),
        *((_ordinal(p), *(_interval(c.strehl[p]) for c in controllers)) for p in PERCENTS),
        ("samples",),
        (
            "unstable, counted as 0 [%]",
            *(_bad_if(c.unstable, _interval(c.unstable_share, 2)) for c in controllers),
        ),
        ("evaluated", *(str(c.samples) for c in controllers)),
        ("failed", *(_bad_if(c.failed, str(c.failed)) for c in controllers)),
    ]
    caption = "Strehl ratio over the samples, with 95 % intervals for independent samples"
    return _table_by_controller(caption, "of the Strehl ratio [%]", statistics, rows)


def residual_table(statistics: StudyStatistics) -> Table:
    """Percentiles of the residual of each controller."""
    unit, factor = shown_unit("nm rms")

    def text(residual_nm: float) -> str:
        if np.isinf(residual_nm):
            return "unstable"
        return cell_text(residual_nm * factor, shown_format(".1f", factor))

    rows: list[_Row] = [
        (_ordinal(p), *(text(c.residual_nm[p].value) for c in statistics.controllers))
        for p in PERCENTS
    ]
    caption = "Residual of tip and tilt over the samples"
    return _table_by_controller(caption, f"residual [{unit}]", statistics, rows)


def sensitivity_table(statistics: StudyStatistics) -> Table:
    """First-order indices of the parameters, one column per controller, and what they lack."""
    controllers = statistics.controllers
    rows: list[_Row] = [
        (name, *(_with_error(*c.index(name)) for c in controllers)) for name in statistics.ranked
    ]
    if rows:
        rest = []
        for controller in controllers:
            pairs = np.array([controller.index(name) for name in controller.ranked]).reshape(-1, 2)
            total = float(np.sum(pairs[:, 0])) if len(pairs) else np.nan
            rest.append(_with_error(1 - total, float(np.linalg.norm(pairs[:, 1]))))
        rows.append(("only together (interactions)", *rest))
    caption = "Variance of the Strehl ratio that one parameter explains by itself [%]"
    return _table_by_controller(caption, "parameter", statistics, rows)


def worst_table(
    controller: ControllerStatistics,
    columns: Mapping[str, ArrayLike],
    parameters: Sequence[str],
) -> Table:
    """List the samples on which a controller does worst, from the columns of the results."""
    places, name = list(controller.worst), controller.controller

    def at(column: str) -> list[float]:
        return [float(value) for value in np.asarray(columns[column], dtype=np.float64)[places]]

    rows = [f"{row:.0f}" for row in at("row")]
    strehls: list[str | Cell] = [
        percent(strehl) if stable else Cell(text="unstable", tone="bad")
        for strehl, stable in zip(at(f"{name}.strehl"), at(f"{name}.stable"), strict=True)
    ]
    values = [[f"{value:.5g}" for value in at(parameter)] for parameter in parameters]
    return Table(
        caption=f"Worst samples of {name}",
        headings=("row", "Strehl [%]", *parameters),
        rows=tuple(zip(rows, strehls, *values, strict=True)),
    )


def percent(value: float, digits: int = 1) -> str:
    """Return a part as a percentage, a dash if it is nan."""
    return cell_text(100 * value, f".{digits}f")


def _ordinal(percentile: float) -> str:
    return f"{percentile:g}{'st' if percentile == 1 else 'th'} percentile"


def _table_by_controller(
    caption: str, heading: str, statistics: StudyStatistics, rows: Sequence[_Row]
) -> Table:
    headings = (heading, *(controller.controller for controller in statistics.controllers))
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
