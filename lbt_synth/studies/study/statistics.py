"""Statistics of a study: each controller, comparisons of them, and what they depend on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, NonFiniteError, ProblemError
from lbt_synth.validation import BoolArray, FloatArray, IntArray, float_array

PERCENTS = (1.0, 5.0, 25.0, 50.0, 75.0, 95.0, 99.0)
LEVELS = (0.3, 0.5, 0.7, 0.8)
CONFIDENCE = 0.95
_MOST_WORST = 10  # samples that are listed
_PARTS = ("turbulence", "vibration", "noise", "within")
_EQUAL = 1e-6  # difference of Strehl ratios that is rounding: the accuracy of the evaluation
_FEWEST = 20  # samples for an index
_CONSTANT = 1e-12  # of the largest result: a smaller scatter is rounding
# With more groups than 8 and fewer samples, one parameter of a Sobol sequence inherits up to 9 % of
# another (benchmarks/study_statistics.py)
_FEW_GROUPS, _MANY_SAMPLES = 8, 4096
_GROUPS = ((200, 4), (1600, 8), (20_000, 16))  # of a curve: samples, and groups if there are fewer
_MOST_GROUPS = 32
_MOST_VALUES = 32  # a parameter with more distinct values is continuous


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A percentile or a share of samples, with the 95 % interval of the true one."""

    value: float  # nan if there is no sample
    low: float  # nan if the sample is too small for a limit
    high: float


_NONE = Interval(value=np.nan, low=np.nan, high=np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerSamples:
    """One controller on n samples; all arrays (n,)."""

    controller: str  # its name
    strehl: FloatArray  # 0 where unstable, nan where the evaluation failed
    residual_nm: FloatArray  # [nm rms]; inf where unstable, nan where the evaluation failed
    evaluated: BoolArray  # where the evaluation did not fail
    unstable: BoolArray
    parts_nm: dict[str, FloatArray]  # of the residual, by origin [nm rms]


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
    above: dict[float, Interval]  # share of the samples whose Strehl ratio is above each level
    residual_nm: dict[float, Interval]  # percentiles of the residual [nm rms]
    parts_nm: dict[str, float]  # median of each part of the residual over the stable loops [nm rms]
    best: Interval  # share of the samples on which no controller has a higher Strehl ratio
    loss: dict[float, Interval]  # percentiles of the highest Strehl ratio of all minus this one
    worst: tuple[int, ...]  # places of the samples on which it does worst, the worst first
    # for each parameter: index, the part of the variance that it explains by itself, index_error,
    # and spearman, the rank correlation; nan for a constant
    sensitivity: dict[str, dict[str, float]]
    # Strehl ratio in groups of each parameter that varies, (k,) each: the parameter, mean, low, its
    # 10th percentile, and unstable, the part of the loops
    curves: dict[str, dict[str, FloatArray]]

    @property
    def ranked(self) -> tuple[str, ...]:
        """The parameters that vary, by falling index."""
        index = {name: row["index"] for name, row in self.sensitivity.items()}
        return tuple(sorted((n for n in index if np.isfinite(index[n])), key=lambda n: -index[n]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyStatistics:
    """Statistics of a study."""

    samples: int  # samples in the study so far
    parameters: tuple[str, ...]  # their names
    controllers: tuple[ControllerStatistics, ...]  # each controller by itself
    # each controller less each later one on the samples on which neither failed: the parts better
    # and equal, mean, mean_error and percentiles of the difference of the Strehl ratios
    comparisons: dict[str, dict[str, float]]

    @property
    def ranked(self) -> tuple[str, ...]:
        """The parameters with an index for any controller, by falling greatest index."""
        pairs = [
            (each.sensitivity[name]["index"], name)
            for each in self.controllers
            for name in each.ranked
        ]
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
        evaluation failed); ``NAME.turbulence_nm``, ``NAME.vibration_nm``, ``NAME.noise_nm``,
        ``NAME.within_nm`` and
        ``row`` (number of the sample) are optional.
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
    samples = [read_controller_samples(columns, name, size) for name in controllers]
    values = {name: read_column(columns, name, size, finite=True) for name in parameters}
    rows = np.arange(size)
    if "row" in columns:
        rows = read_column(columns, "row", size, finite=True).astype(np.int64)
    orders = {name: np.argsort(numbers) for name, numbers in values.items()}
    return StudyStatistics(
        samples=size,
        parameters=tuple(parameters),
        controllers=tuple(
            _controller_statistics(each, loss, rows, values, orders)
            for each, loss in zip(samples, sample_losses(samples), strict=True)
        ),
        comparisons={
            f"{first.controller} less {second.controller}": _compare(first, second)
            for first, second in combinations(samples, 2)
        },
    )


def _controller_statistics(
    samples: ControllerSamples,
    loss: FloatArray,
    rows: IntArray,
    values: Mapping[str, FloatArray],
    orders: Mapping[str, IntArray],
) -> ControllerStatistics:
    """Return the statistics of one controller, given the order of each parameter's values."""
    from scipy.stats import rankdata

    strehl = samples.strehl[samples.evaluated]
    mean, error = mean_and_error(strehl)
    ranks = np.asarray(rankdata(samples.strehl, nan_policy="omit"))
    dependence = {n: _sensitivity(values[n], orders[n], samples, ranks) for n in values}
    stable = samples.evaluated & ~samples.unstable
    return ControllerStatistics(
        controller=samples.controller,
        samples=len(strehl),
        failed=len(samples.strehl) - len(strehl),
        unstable=int(np.count_nonzero(samples.unstable)),
        unstable_share=share(samples.unstable[samples.evaluated]),
        mean=mean,
        mean_error=error,
        strehl=percentiles(strehl, PERCENTS),
        above={level: share(strehl > level) for level in LEVELS},
        residual_nm=percentiles(samples.residual_nm[samples.evaluated], PERCENTS),
        parts_nm={
            part: float(np.median(numbers[stable])) if stable.any() else np.nan
            for part, numbers in samples.parts_nm.items()
        },
        best=share(loss <= _EQUAL),
        loss=percentiles(loss, (50.0, 95.0, 99.0)),
        worst=_worst(samples, rows),
        sensitivity={name: row for name, (row, _) in dependence.items()},
        curves={name: curve for name, (_, curve) in dependence.items() if curve},
    )


def _worst(samples: ControllerSamples, rows: IntArray) -> tuple[int, ...]:
    """Return the places of the samples of least Strehl ratio, the unstable ones first."""
    places = np.flatnonzero(samples.evaluated)
    order = np.lexsort((rows[places], samples.strehl[places], ~samples.unstable[places]))
    return tuple(places[order[:_MOST_WORST]].tolist())


def _compare(first: ControllerSamples, second: ControllerSamples) -> dict[str, float]:
    """Compare two controllers sample by sample."""
    both = first.evaluated & second.evaluated
    difference = first.strehl[both] - second.strehl[both]
    mean, error = mean_and_error(difference)
    low, median, high = percentiles(difference, (5.0, 50.0, 95.0)).values()
    return {
        "better": share(difference > _EQUAL).value,
        "equal": share(np.abs(difference) <= _EQUAL).value,
        "mean": mean,
        "mean_error": error,
        "5th percentile": low.value,
        "median": median.value,
        "95th percentile": high.value,
    }


def sample_losses(controllers: Sequence[ControllerSamples]) -> tuple[FloatArray, ...]:
    """Return for each controller the best Strehl ratio minus its own, on every sample (m,)."""
    whole = np.logical_and.reduce([each.evaluated for each in controllers])
    best = np.max([each.strehl[whole] for each in controllers], axis=0)
    return tuple(best - each.strehl[whole] for each in controllers)


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
    if finite:
        _refuse_where(~np.isfinite(out), out, NonFiniteError, f"column {name!r} must be finite")
    return out


def read_controller_samples(
    columns: Mapping[str, Any], controller: str, size: int | None = None
) -> ControllerSamples:
    """Read the columns of a controller, (n,) each."""
    stable_column = read_column(columns, f"{controller}.stable", size)
    size = len(stable_column)
    evaluated, unstable = ~np.isnan(stable_column), stable_column == 0
    stable = stable_column == 1
    demand = f"column '{controller}.stable' must be 1, 0 or nan"
    _refuse_where(evaluated & ~unstable & ~stable, stable_column, ProblemError, demand)
    results = {}
    for name, most, range_, lost in (
        ("strehl", 1 + 1e-9, "within [0, 1]", 0.0),
        ("residual_nm", np.inf, "at least 0", np.inf),
    ):
        values = read_column(columns, f"{controller}.{name}", size)
        demand = (
            f"column '{controller}.{name}' must be finite and {range_} where the loop is stable"
        )
        _refuse_where(stable & ~np.isfinite(values), values, NonFiniteError, demand)
        outside = ~((values >= 0) & (values <= most))
        _refuse_where(stable & outside, values, ProblemError, demand)
        results[name] = np.where(stable, values, np.where(evaluated, lost, np.nan))
    parts = {part: f"{controller}.{part}_nm" for part in _PARTS}
    return ControllerSamples(
        controller=controller,
        **results,
        evaluated=evaluated,
        unstable=unstable,
        parts_nm={p: read_column(columns, n, size) for p, n in parts.items() if n in columns},
    )


def _refuse_where(
    wrong: BoolArray, values: FloatArray, error: type[ProblemError], demand: str
) -> None:
    """Refuse a column with wrong values, and show the first."""
    if np.any(wrong):
        row = int(np.argmax(wrong))
        raise error(f"{demand}; got {values[row]:g} at index {row}. Check the file of the results.")


def percentiles(values: FloatArray, percents: Sequence[float]) -> dict[float, Interval]:
    """Return percentiles of a sample (n,), with intervals from order statistics."""
    from scipy.stats import binom

    n, tail = len(values), (1 - CONFIDENCE) / 2
    if n == 0:
        return dict.fromkeys(percents, _NONE)
    ordered = np.sort(values)
    limits = np.concatenate(([np.nan], ordered, [np.nan]))  # none before the first, after the last
    table = {}
    for percent in percents:
        first = int(binom.ppf(tail, n, percent / 100))
        last = int(binom.ppf(1 - tail, n, percent / 100)) + 1
        low, high = limits[[max(first, 0), last]].tolist()
        value = _interpolate(ordered, percent / 100)
        table[percent] = Interval(value=value, low=low, high=high)
    return table


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
    from scipy.special import betaincinv

    count, total = int(np.count_nonzero(where)), len(where)
    if total == 0:
        return _NONE
    tail = (1 - CONFIDENCE) / 2
    low = float(betaincinv(count, total - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, total - count, 1 - tail)) if count < total else 1.0
    return Interval(value=count / total, low=low, high=high)


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean and its standard error for independent samples; nan if too few."""
    n = len(values)
    mean = float(np.mean(values)) if n else np.nan
    return mean, float(np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else np.nan


def _sensitivity(
    values: FloatArray, order: IntArray, samples: ControllerSamples, ranks: FloatArray
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return how the Strehl ratio depends on one parameter, and its curve."""
    order = order[samples.evaluated[order]]
    ordered, strehl = values[order], samples.strehl[order]
    if len(ordered) < _FEWEST or ordered[0] == ordered[-1]:
        return dict.fromkeys(("index", "index_error", "spearman"), np.nan), {}
    index, error = first_order_index(ordered, strehl)
    with np.errstate(invalid="ignore"):  # nan if the Strehl ratio is constant
        spearman = float(np.corrcoef(_ranks(ordered), ranks[order])[0, 1])
    row = {"index": index, "index_error": error, "spearman": spearman}
    return row, conditional_curve(ordered, strehl, samples.unstable[order])


def first_order_index(ordered: FloatArray, result: FloatArray) -> tuple[float, float]:
    """Return ``Var(E[y | x]) / Var(y)`` of a result y (n,) for a parameter in rising order (n,).

    Its standard error comes with it; both are nan if the result or the parameter is constant. The
    mean given x is a line in each of n^(1/3) groups of equal size, at most 8 below 4096
    samples (E. Plischke, E. Borgonovo, C. L. Smith, Eur. J. Oper. Res. 226, 536 (2013)), and one
    value for each of a list.
    """
    n = len(ordered)
    largest = float(np.max(np.abs(result), initial=0.0))
    scaled = result / (largest or 1.0)
    spread = scaled - np.mean(scaled)
    total = float(spread @ spread)
    if total <= n * _CONSTANT**2:
        return np.nan, np.nan
    if is_list(ordered):
        starts = value_starts(ordered)
        coefficients = len(starts)
        counts = np.diff(np.append(starts, n))
        fit = np.repeat(np.add.reduceat(spread, starts) / counts, counts)
        scatter = float(np.sum((spread - fit) ** 2)) / (n - coefficients)
    else:
        groups = round(n ** (1 / 3))
        starts = group_starts(ordered, groups if n >= _MANY_SAMPLES else min(groups, _FEW_GROUPS))
        coefficients = 2 * len(starts)
        fit, jumps = _lines(spread, _ranks(ordered), starts)
        scatter = float(np.sum((spread - fit) ** 2)) / (n - coefficients)
        # a jump between lines of n / B samples has 8 B / n of the variance of their scatter,
        # which is less for even samples than for independent ones
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


def conditional_curve(
    ordered: FloatArray, strehl: FloatArray, unstable: BoolArray
) -> dict[str, FloatArray]:
    """Return the Strehl ratio (n,) in groups of a parameter in rising order (n,), by column."""
    n = len(ordered)
    groups = next((k for limit, k in _GROUPS if n < limit), _MOST_GROUPS)
    starts = value_starts(ordered) if is_list(ordered) else group_starts(ordered, groups)
    rows = []
    for group in np.split(np.arange(n), starts[1:]):
        here = strehl[group]
        middle = 0.5 * (ordered[group[(len(group) - 1) // 2]] + ordered[group[len(group) // 2]])
        rows.append((middle, np.mean(here), np.percentile(here, 10), np.mean(unstable[group])))
    names = ("parameter", "mean", "low", "unstable")
    return dict(zip(names, np.array(rows, dtype=np.float64).T, strict=True))


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
