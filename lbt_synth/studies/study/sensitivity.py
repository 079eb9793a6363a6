"""Sensitivity of each controller's Strehl ratio to each parameter: index, rank, curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.studies.study.percentiles import mean_and_error
from lbt_synth.validation import BoolArray, FloatArray, IntArray, frozen_copy

FEWEST = 20  # samples for an index
_MOST_VALUES = 32  # a parameter with more distinct values is continuous
_MOST_INTERVALS = 8  # with fewer samples than _MANY_SAMPLES
_MANY_SAMPLES = 4096
_GROUPS = ((200, 4), (1600, 8), (20_000, 16))  # samples, and groups if there are fewer
_MOST_GROUPS = 32
_MIDDLE = 0.05, 0.95
_FEWEST_OF_LINE = 3  # samples on either side of an edge
_CLEAR = 20.0  # F-value of an edge, beyond what chance gives some thousand intervals
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class VarianceIndex:
    """First-order index of one parameter."""

    value: float  # about 0 without an effect; nan if the result or the parameter is constant
    error: float  # standard error for independent samples; an overestimate for stratified ones
    correction: float  # subtracted for the scatter of the fit
    groups: int  # values of a list, or intervals of a continuous parameter


NO_INDEX = VarianceIndex(value=np.nan, error=np.nan, correction=np.nan, groups=0)


def is_list(ordered: FloatArray) -> bool:
    """Whether a parameter, given in rising order, takes few values, as from a list of a study."""
    distinct = 1 + int(np.count_nonzero(np.diff(ordered)))
    return distinct <= min(_MOST_VALUES, max(2, len(ordered) // 5))


def value_starts(ordered: FloatArray) -> IntArray:
    """Return the first index of each value of a list, given in rising order."""
    return np.concatenate(([0], 1 + np.flatnonzero(np.diff(ordered)))).astype(np.int64)


def group_starts(n: int, groups: int) -> IntArray:
    """Return the first index of each of some groups whose sizes differ by one at most."""
    return (np.arange(groups) * n // groups).astype(np.int64)


def first_order_index(ordered: FloatArray, result: FloatArray) -> VarianceIndex:
    r"""First-order index ``Var(E[y | x]) / Var(y)`` of a parameter, without further samples.

    Parameters
    ----------
    ordered : (n,) ndarray
        The parameter's samples in rising order.
    result : (n,) ndarray
        The results, in the same order.

    Returns
    -------
    VarianceIndex
        The index.

    Notes
    -----
    The mean of y given x is fitted by a straight line over the rank of x in each of B intervals
    of equal probability (B is the cube root of n, at most 8 below 4096 samples), or by one mean
    for each value of a list. With one mean an interval this is the correlation ratio, the
    estimator from given data of E. Plischke, E. Borgonovo and C. L. Smith, Eur. J. Oper. Res.
    226, 536 (2013), doi:10.1016/j.ejor.2012.11.047; lines need fewer intervals for the same
    curve. A fit of p coefficients takes up a part ``(p - 1) s^2`` of the scatter, which is
    subtracted (T. L. Kelley, Proc. Natl. Acad. Sci. 21, 554 (1935), doi:10.1073/pnas.21.9.554,
    for means). ``s^2`` is the scatter about the fit for independent samples. Samples of a
    Sobol sequence or a Latin hypercube scatter less about the mean of an interval: there
    the jumps between neighbouring lines, of variance ``8 s^2 B / n``, tell how much. Where two
    lines fit an interval clearly better than one (by an F-test), it is parted in two: a loop that
    becomes unstable beyond some value of x leaves an edge.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies import first_order_index
    >>> x = (np.arange(1000) + 0.5) / 1000
    >>> round(first_order_index(x, x).value, 6)
    1.0
    """
    n = len(ordered)
    spread = result - np.mean(result)
    total = float(spread @ spread)
    scale = float(np.max(np.abs(result), initial=0.0))
    if n < FEWEST or ordered[0] == ordered[-1] or total <= n * (1e-12 * scale) ** 2:
        return NO_INDEX
    jumps: FloatArray | None = None
    if is_list(ordered):
        starts = value_starts(ordered)
        coefficients = len(starts)
        fit = _means(spread, starts)
    else:
        groups = round(n ** (1 / 3))
        starts = group_starts(n, groups if n >= _MANY_SAMPLES else min(groups, _MOST_INTERVALS))
        edges = _edges(spread, starts)
        starts = np.sort(np.concatenate([starts, edges]))
        coefficients = 2 * len(starts) + len(edges)
        fit, jumps = _lines(spread, starts)
        jumps = jumps[~np.isin(starts[1:], edges)]
    rest = spread - fit
    squares = rest * rest
    unexplained = float(np.sum(squares)) / total
    scatter = float(np.sum(squares)) / (n - coefficients)
    if jumps is not None:
        scatter = min(scatter, float(np.mean(jumps**2)) / 8 * n / len(starts))
    correction = (coefficients - 1) * scatter / total
    # what a sample adds to the index, to first order; then the scatter of the fit
    influence = (squares - unexplained * spread * spread) * (n / total)
    error = max(
        float(np.std(influence)) / np.sqrt(n), unexplained * np.sqrt(2 * (coefficients - 1)) / n
    )
    return VarianceIndex(
        value=1 - unexplained - correction,
        error=float(error),
        correction=correction,
        groups=len(starts),
    )


def _means(values: FloatArray, starts: IntArray) -> FloatArray:
    """Return for every sample the mean of its group."""
    counts = np.diff(np.append(starts, len(values)))
    means: FloatArray = np.repeat(np.add.reduceat(values, starts) / counts, counts)
    return means


def _edges(values: FloatArray, starts: IntArray) -> IntArray:
    """Return where to part the groups that two lines fit clearly better than one."""
    edges = []
    for start, group in zip(starts, np.split(values, starts[1:]), strict=True):
        m = len(group)
        least = max(_FEWEST_OF_LINE, m // 32)
        before, after = _line_squares(group), _line_squares(group[::-1])[::-1]
        # squares about two lines that meet before sample k, for k = least ... m - least
        both = before[least - 1 : m - least] + after[least : m - least + 1]
        if both.size == 0:
            continue
        best = int(np.argmin(both))
        gained = float(before[-1] - both[best])
        if gained * (m - 4) > 2 * _CLEAR * both[best] and gained > _ROUNDING * float(group @ group):
            edges.append(int(start) + least + best)
    return np.array(edges, dtype=np.int64)


def _line_squares(values: FloatArray) -> FloatArray:
    """Return the sum of squares about a line through the first k values, for each k."""
    place, per_count, per_spread = _line_places(len(values))
    total = np.cumsum(values)
    slope = np.cumsum(place * values) - 0.5 * place * total
    explained = total * total * per_count + slope * slope * per_spread
    return np.maximum(np.cumsum(values * values) - explained, 0.0)


@lru_cache(maxsize=2)  # sizes of groups differ by one at most
def _line_places(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return places from 0, and for the first k of them 1 / k and 1 / their spread, (n,) each."""
    k = np.arange(1.0, n + 1)
    spread = np.maximum(k * (k * k - 1) / 12, 0.5)  # the slope of one value is 0
    return k - 1, 1 / k, 1 / spread


def _lines(values: FloatArray, starts: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the lines fitted to each group at every sample, and the jumps between neighbours."""
    n = len(values)
    counts = np.diff(np.append(starts, n))
    middle = starts + (counts - 1) / 2
    # from -1 to 1 over the group
    place = (np.arange(n) - np.repeat(middle, counts)) / np.repeat(counts / 2, counts)
    means = np.add.reduceat(values, starts) / counts
    slopes = np.add.reduceat(place * values, starts) / np.add.reduceat(place * place, starts)
    fit = np.repeat(means, counts) + np.repeat(slopes, counts) * place
    left, right = means - slopes, means + slopes
    return fit, left[1:] - right[:-1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConditionalCurve:
    """Strehl ratio in k groups of one parameter, whatever the others are; all arrays (k,)."""

    parameter: FloatArray  # its median in each group, or the values of a list
    low_edge: FloatArray  # its least value in each group
    high_edge: FloatArray  # its greatest value in each group
    mean: FloatArray  # Strehl ratio
    mean_error: FloatArray  # standard error of the mean
    low: FloatArray  # 10th percentile of the Strehl ratio
    high: FloatArray  # 90th percentile
    unstable: FloatArray  # part of the loops that are unstable
    samples: FloatArray  # number in each group
    discrete: bool  # whether the groups are the values of a list

    def swing(self) -> tuple[float, float]:
        """Return the range of the mean over the middle 90 % of samples, and its error."""
        end = np.cumsum(self.samples)
        centre = (end - self.samples / 2) / end[-1]
        inside = self.discrete | ((centre >= _MIDDLE[0]) & (centre <= _MIDDLE[1]))
        places = np.flatnonzero(inside)
        top = places[np.argmax(self.mean[places])]
        bottom = places[np.argmin(self.mean[places])]
        error = np.hypot(self.mean_error[top], self.mean_error[bottom])
        return float(self.mean[top] - self.mean[bottom]), float(error)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParameterSensitivity:
    """How a controller's Strehl ratio depends on one parameter."""

    parameter: str  # its name
    index: VarianceIndex = NO_INDEX  # part of the variance that it explains by itself
    spearman: float = np.nan  # rank correlation, in [-1, 1]; nan if either is constant
    swing: float = np.nan  # see ConditionalCurve.swing; nan for a constant
    swing_error: float = np.nan  # its standard error
    curve: ConditionalCurve | None = None  # None for a constant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControllerSensitivity:
    """How one controller's Strehl ratio depends on all parameters."""

    controller: str  # its name
    samples: int  # samples on which it did not fail
    parameters: tuple[ParameterSensitivity, ...]  # in the order of the study

    @property
    def ranked(self) -> tuple[ParameterSensitivity, ...]:
        """The parameters that vary, by falling index."""
        varying = [each for each in self.parameters if np.isfinite(each.index.value)]
        return tuple(sorted(varying, key=lambda each: -each.index.value))

    def find(self, name: str) -> ParameterSensitivity:
        """Return the sensitivity to one parameter."""
        return next(each for each in self.parameters if each.parameter == name)

    @property
    def sum(self) -> float:
        """Sum of the indices; nan if there is none."""
        return float(np.sum([e.index.value for e in self.ranked] or [np.nan]))

    @property
    def sum_error(self) -> float:
        """Root of the sum of squares of their errors; nan if there is none."""
        return float(np.linalg.norm([e.index.error for e in self.ranked] or [np.nan]))

    @property
    def interactions(self) -> float:
        """1 minus the sum: the part that only several independent parameters explain together."""
        return 1 - self.sum


def sensitivities(
    controllers: Sequence[ControllerSamples], parameters: Mapping[str, FloatArray]
) -> tuple[ControllerSensitivity, ...]:
    """Return the sensitivity of each controller's Strehl ratio to each parameter, (n,) each."""
    orders = {name: _rising_order(values) for name, values in parameters.items()}
    return tuple(
        ControllerSensitivity(
            controller=each.controller,
            samples=int(np.count_nonzero(each.evaluated)),
            parameters=tuple(
                _sensitivity(name, values, each, orders[name], ranks)
                for name, values in parameters.items()
            ),
        )
        for each, ranks in zip(controllers, map(_rank, controllers), strict=True)
    )


def _rising_order(values: FloatArray) -> IntArray:
    """Return what sorts values, with equal ones in the order of the samples, (n,)."""
    order = np.argsort(values)  # several times as quick as a stable one
    differ = np.all(np.diff(values[order]) > 0)
    return order if differ else np.argsort(values, kind="stable")


def _sensitivity(
    name: str, values: FloatArray, each: ControllerSamples, order: IntArray, ranks: FloatArray
) -> ParameterSensitivity:
    """Return the sensitivity to one parameter, given the order of its values."""
    if not each.evaluated.all():
        order = order[each.evaluated[order]]
    ordered, strehl = values[order], each.strehl[order]
    if len(ordered) < FEWEST or ordered[0] == ordered[-1]:
        return ParameterSensitivity(parameter=name)
    curve = conditional_curve(ordered, strehl, each.unstable[order])
    swing, error = curve.swing()
    with np.errstate(invalid="ignore"):  # nan if the Strehl ratio is constant
        spearman = float(np.corrcoef(_rank_ordered(ordered), ranks[order])[0, 1])
    return ParameterSensitivity(
        parameter=name,
        index=first_order_index(ordered, strehl),
        spearman=spearman,
        swing=swing,
        swing_error=error,
        curve=curve,
    )


def conditional_curve(
    ordered: FloatArray, strehl: FloatArray, unstable: BoolArray
) -> ConditionalCurve:
    """Return the Strehl ratio (n,) in groups of a parameter, given in rising order (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies.study.sensitivity import conditional_curve
    >>> gains = np.repeat([0.5, 1.0], 100)
    >>> curve = conditional_curve(gains, 0.8 * gains, gains < 0)
    >>> curve.mean, round(curve.swing()[0], 6)
    (array([0.4, 0.8]), 0.4)
    """
    n = len(ordered)
    discrete = is_list(ordered)
    if discrete:
        starts = value_starts(ordered)
    else:
        groups = next((k for limit, k in _GROUPS if n < limit), _MOST_GROUPS)
        starts = group_starts(n, groups)
    rows = []
    for group in np.split(np.arange(n), starts[1:]):
        inside, here = ordered[group], strehl[group]
        mean, error = mean_and_error(here)
        low, high = np.percentile(here, (10, 90))
        part = np.mean(unstable[group])
        middle = 0.5 * (inside[(len(group) - 1) // 2] + inside[len(group) // 2])
        ends = middle, inside[0], inside[-1]
        rows.append((*ends, mean, error, low, high, part, len(group)))
    names = (field.name for field in fields(ConditionalCurve) if field.name != "discrete")
    columns = dict(zip(names, map(frozen_copy, zip(*rows, strict=True)), strict=True))
    return ConditionalCurve(**columns, discrete=discrete)


def _rank(each: ControllerSamples) -> FloatArray:
    """Return the ranks of the Strehl ratio, their mean for ties; nan where it failed."""
    from scipy.stats import rankdata

    return np.asarray(rankdata(each.strehl, nan_policy="omit"))


def _rank_ordered(ordered: FloatArray) -> FloatArray:
    """Return the ranks of values that are in order."""
    starts = value_starts(ordered)
    counts = np.diff(np.append(starts, len(ordered)))
    ranks: FloatArray = np.repeat(starts + (counts + 1) / 2, counts)
    return ranks
