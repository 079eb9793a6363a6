"""Statistics of a study and their tables: percentiles, and what the Strehl ratio depends on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.storage.display_unit import shown_format, shown_unit
from lbt_synth.storage.rows import cell_text
from lbt_synth.storage.tables import Cell, Table
from lbt_synth.validation import BoolArray, FloatArray, IntArray, float_array

PERCENTS = (1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0)
CONFIDENCE = 0.95  # of the interval of a percentile or a share
_MOST_WORST = 10  # samples that are listed
_FEWEST = 20  # samples for an index
_CONSTANT = 1e-12  # scatter of a Strehl ratio that is rounding
# With more groups than 8 and fewer samples, one parameter of a Sobol sequence inherits up to 9 % of
# another
_FEW_GROUPS, _MANY_SAMPLES = 8, 4096
_MOST_VALUES = 32  # a parameter with more distinct values is continuous

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
        row = self.sensitivity[name]
        return row["index"], row["index_error"]


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
    columns: Mapping[str, ArrayLike],
    parameters: Sequence[str],
    controllers: Sequence[str],
) -> StudyStatistics:
    """Compute the statistics of a study's results.

    Parameters
    ----------
    columns : mapping of str to (n,) array_like
        Results: each parameter under its name and, for each controller, ``NAME.strehl`` (nan
        where unstable or failed), ``NAME.residual_nm`` and ``NAME.stable`` (1, 0; nan where the
        evaluation failed); ``row`` (number of the sample) is optional.
    parameters : sequence of str
        Names of the parameters.
    controllers : sequence of str
        Names of the controllers.

    Returns
    -------
    StudyStatistics
        An unstable loop counts as a Strehl ratio of 0; failed evaluations are left out and
        counted.

    Raises
    ------
    ProblemError
        If a column is missing or holds impossible values.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> gain = np.linspace(0.5, 1.5, 201)
    >>> stable = (gain < 1.4).astype(float)
    >>> columns = {
    ...     "gain": gain,
    ...     "a.stable": stable,
    ...     "a.residual_nm": 100 / gain,
    ...     "a.strehl": np.where(stable, 0.6 * gain, np.nan),
    ... }
    >>> only = lbt.studies.study_statistics(columns, ["gain"], ["a"]).controllers[0]
    >>> only.samples, only.unstable, round(only.strehl[50].value, 3), only.worst[0]
    (201, 21, 0.537, 180)
    """
    for names, what in ((parameters, "parameters"), (controllers, "controllers")):
        if isinstance(names, str) or len(set(names)) != len(names):
            raise ProblemError(f"{what} must be a list of different names; got {names!r}.")
    if not controllers:
        raise ProblemError("controllers must name one at least; got none.")
    size = len(read_column(columns, f"{controllers[0]}.stable"))
    if not size:
        raise ProblemError("the results must have at least one sample; got none.")
    samples = {name: read_controller_samples(columns, name, size) for name in controllers}
    values = {name: read_column(columns, name, size, finite=True) for name in parameters}
    rows = np.arange(size)
    if "row" in columns:
        rows = read_column(columns, "row", size, finite=True).astype(np.int64)
    orders = {name: np.argsort(numbers) for name, numbers in values.items()}
    return StudyStatistics(
        samples=size,
        parameters=tuple(parameters),
        controllers=tuple(
            _controller_statistics(name, columns, rows, values, orders)
            for name, columns in samples.items()
        ),
    )


def _controller_statistics(
    controller: str,
    samples: Samples,
    rows: IntArray,
    values: Mapping[str, FloatArray],
    orders: Mapping[str, IntArray],
) -> ControllerStatistics:
    """Return the statistics of one controller, with the order of each parameter's values."""
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
        sensitivity={name: _sensitivity(values[name], orders[name], samples) for name in values},
    )


def read_column(
    columns: Mapping[str, Any], name: str, size: int | None = None, *, finite: bool = False
) -> FloatArray:
    """Return a column of the results, of the given length if there is one."""
    if name not in columns:
        raise ProblemError(
            f"the results must have a column {name!r}; got {', '.join(map(repr, columns))}. "
            "Check the names of parameters and controllers."
        )
    out = float_array(columns[name], f"column {name!r}")
    if out.ndim != 1 or (size is not None and len(out) != size):
        demand = "be 1-D" if size is None else f"have {size} rows, as the others"
        raise DimensionError(f"column {name!r} must {demand}; got shape {out.shape}.")
    _refuse_where(finite & ~np.isfinite(out), out, f"column {name!r} must be finite")
    return out


def read_controller_samples(
    columns: Mapping[str, Any], controller: str, size: int | None = None
) -> Samples:
    """Read the columns of a controller, (n,) each: results, and what was evaluated and unstable.

    An unstable loop has a Strehl ratio of 0 and an infinite residual, a failed evaluation has nan.
    """
    mark = read_column(columns, f"{controller}.stable", size)
    evaluated, stable = ~np.isnan(mark), mark == 1
    wrong = evaluated & ~stable & (mark != 0)
    _refuse_where(wrong, mark, f"column '{controller}.stable' must be 1, 0 or nan")
    results: Samples = {}
    for name, most, said, lost in (
        ("strehl", 1 + 1e-9, "within [0, 1]", 0.0),
        ("residual_nm", np.finfo(float).max, "finite and at least 0", np.inf),
    ):
        values = read_column(columns, f"{controller}.{name}", mark.size)
        demand = f"column '{controller}.{name}' must be {said} where the loop is stable"
        _refuse_where(stable & ~((values >= 0) & (values <= most)), values, demand)
        results[name] = np.where(stable, values, np.where(evaluated, lost, np.nan))
    return results | {"evaluated": evaluated, "unstable": evaluated & ~stable}


def _refuse_where(wrong: BoolArray, values: FloatArray, demand: str) -> None:
    """Refuse a column with wrong values, and show the first."""
    if np.any(wrong):
        row = int(np.argmax(wrong))
        text = f"{demand}; got {values[row]:g} at index {row}. Check the file of the results."
        raise (ProblemError if np.isfinite(values[row]) else NonFiniteError)(text)


def percentiles(values: FloatArray, percents: Sequence[float]) -> dict[float, Interval]:
    """Return percentiles of a sample (n,), with intervals from order statistics."""
    from scipy.stats import quantile_test

    if len(values) == 0:
        return dict.fromkeys(percents, _NONE)
    ordered, intervals = np.sort(values), {}
    for percent in percents:
        ends: Any = quantile_test(ordered, q=0, p=percent / 100).confidence_interval(CONFIDENCE)
        value = _interpolate(ordered, percent / 100)
        intervals[percent] = Interval(value=value, low=float(ends.low), high=float(ends.high))
    return intervals


def _interpolate(ordered: FloatArray, fraction: float) -> float:
    """Return a quantile by linear interpolation between order statistics; some may be inf."""
    at = fraction * (len(ordered) - 1)
    below = int(at)
    low, weight = float(ordered[below]), at - below
    if weight == 0 or low == ordered[below + 1]:
        return low
    return low + weight * (float(ordered[below + 1]) - low)


def share(where: BoolArray) -> Interval:
    """Return the part of the samples (n,) of a mask, with the interval of Clopper and Pearson."""
    from scipy.stats import binomtest

    if len(where) == 0:
        return _NONE
    count = int(np.count_nonzero(where))
    ends = binomtest(count, len(where)).proportion_ci(CONFIDENCE, method="exact")
    return Interval(value=count / len(where), low=float(ends.low), high=float(ends.high))


def _sensitivity(values: FloatArray, order: IntArray, samples: Samples) -> dict[str, float]:
    """Return how much of the variance of the Strehl ratio one parameter explains."""
    order = order[samples["evaluated"][order]]
    ordered, index = values[order], (np.nan, np.nan)
    if len(ordered) >= _FEWEST and ordered[0] < ordered[-1]:
        index = first_order_index(ordered, samples["strehl"][order])
    return dict(zip(("index", "index_error"), index, strict=True))


def first_order_index(ordered: FloatArray, result: FloatArray) -> tuple[float, float]:
    """Return ``Var(E[y | x]) / Var(y)`` of a result y (n,) for a parameter in rising order (n,).

    Its standard error comes with it; both are nan if the result or the parameter is constant. The
    mean given x is a line in each of n^(1/3) groups of equal size, at most 8 below 4096
    samples (E. Plischke, E. Borgonovo, C. L. Smith, Eur. J. Oper. Res. 226, 536 (2013)), and one
    value for each of a list.
    """
    n = len(ordered)
    spread = result - np.mean(result)
    total = float(spread @ spread)
    if total <= n * _CONSTANT**2:
        return np.nan, np.nan
    if is_list(ordered):
        starts = value_starts(ordered)
        coefficients, jumps = len(starts), np.full(1, np.inf)  # a list has no joints
        counts = np.diff(np.append(starts, n))
        fit = np.repeat(np.add.reduceat(spread, starts) / counts, counts)
    else:
        groups = round(n ** (1 / 3))
        starts = group_starts(ordered, groups if n >= _MANY_SAMPLES else min(groups, _FEW_GROUPS))
        coefficients = 2 * len(starts)
        fit, jumps = _lines(spread, _ranks(ordered), starts)
    # a jump between lines of n / B samples has 8 B / n of the variance of their scatter, which is
    # less for even samples than for independent ones
    scatter = float(np.sum((spread - fit) ** 2)) / (n - coefficients)
    scatter = min(scatter, float(np.mean(jumps**2)) / 8 * n / len(starts))
    squares = (spread - fit) ** 2
    unexplained = float(np.sum(squares)) / total
    # a fit follows some of the scatter (T. L. Kelley, Proc. Natl. Acad. Sci. 21, 554 (1935))
    correction = (coefficients - 1) * scatter / total
    # what a sample adds to the index, to first order; at least the error of an index of 0
    influence = (squares - unexplained * spread * spread) * (n / total)
    least = unexplained * (2 * (coefficients - 1)) ** 0.5 / n
    return 1 - unexplained - correction, max(float(np.std(influence)) / n**0.5, least)


def _lines(
    values: FloatArray, ranks: FloatArray, starts: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return lines over the rank, one for each group, at every sample, and the jumps between."""
    counts = np.diff(np.append(starts, len(values)))
    means = np.add.reduceat(values, starts) / counts
    place = ranks - np.repeat(starts + (counts + 1) / 2, counts)
    widths = np.add.reduceat(place * place, starts)
    slopes = np.add.reduceat(place * values, starts) / np.where(widths > 0, widths, 1.0)
    rises = slopes * counts / 2
    fit = np.repeat(means, counts) + np.repeat(slopes, counts) * place
    return fit, (means - rises)[1:] - (means + rises)[:-1]


def _ranks(ordered: FloatArray) -> FloatArray:
    """Return the ranks of values that are in order."""
    starts = value_starts(ordered)
    counts = np.diff(np.append(starts, len(ordered)))
    ranks: FloatArray = np.repeat(starts + (counts + 1) / 2, counts)
    return ranks


def is_list(ordered: FloatArray) -> bool:
    """Whether a parameter, given in rising order, takes few values, as from a list of a study."""
    distinct = 1 + int(np.count_nonzero(np.diff(ordered)))
    return distinct <= min(_MOST_VALUES, max(2, len(ordered) // 5))


def value_starts(ordered: FloatArray) -> IntArray:
    """Return the first index of each value of a list, given in rising order."""
    return np.concatenate(([0], 1 + np.flatnonzero(np.diff(ordered)))).astype(np.int64)


def group_starts(ordered: FloatArray, groups: int) -> IntArray:
    """Return the first index of each of some groups of about equal size, in rising order.

    Equal values are in one group, so that the order of their samples is of no matter.
    """
    n = len(ordered)
    return np.unique(np.searchsorted(ordered, ordered[np.arange(groups) * n // groups]))


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

    rows = [f"{row:.0f}" for row in at("row")] if "row" in columns else [str(i) for i in places]
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
    """Return the name of one of the percentiles."""
    return f"{percentile:g}{'st' if percentile == 1 else 'th'} percentile"


def _table_by_controller(
    caption: str, heading: str, statistics: StudyStatistics, rows: Sequence[_Row]
) -> Table:
    """Return a table with a column per controller."""
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
