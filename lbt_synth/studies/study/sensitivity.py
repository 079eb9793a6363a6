"""Sensitivity of each controller's Strehl ratio to each parameter: index, rank, curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from lbt_synth.studies.study.binning import group_starts, is_list, value_starts
from lbt_synth.studies.study.controller_samples import ControllerSamples
from lbt_synth.studies.study.percentiles import mean_and_error
from lbt_synth.validation import BoolArray, FloatArray, IntArray, frozen_copy

_GROUPS = ((200, 4), (1600, 8), (20_000, 16))  # samples, and groups if there are fewer
_MOST_GROUPS = 32
_MIDDLE = 0.05, 0.95
_RARE = 0.01  # of the samples, too few for a value of a list
_FEWEST = 20  # samples for an index
# With more groups than 8 and fewer samples, one parameter of a Sobol sequence inherits up to 9 % of
# another (benchmarks/study_statistics.py)
_FEW_GROUPS, _MANY_SAMPLES = 8, 4096
_CONSTANT = 1e-12  # of the largest result: a smaller scatter is rounding


@dataclass(frozen=True, slots=True, kw_only=True)
class VarianceIndex:
    """First-order index of one parameter."""

    value: float  # about 0 without an effect; nan if the result or the parameter is constant
    error: float  # standard error for independent samples; an overestimate for stratified ones


NO_INDEX = VarianceIndex(value=np.nan, error=np.nan)


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
        """Return the range of the mean over the middle 90 % of samples, and its error.

        Of a list over all values, but for those that hardly any sample has.
        """
        end = np.cumsum(self.samples)
        centre = (end - self.samples / 2) / end[-1]
        if self.discrete:
            inside = self.samples >= max(2.0, _RARE * end[-1])
        else:
            inside = (centre >= _MIDDLE[0]) & (centre <= _MIDDLE[1])
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
    orders = {name: np.argsort(values) for name, values in parameters.items()}
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


def _sensitivity(
    name: str, values: FloatArray, each: ControllerSamples, order: IntArray, ranks: FloatArray
) -> ParameterSensitivity:
    """Return the sensitivity to one parameter, given the order of its values."""
    if not each.evaluated.all():
        order = order[each.evaluated[order]]
    ordered, strehl = values[order], each.strehl[order]
    if len(ordered) < _FEWEST or ordered[0] == ordered[-1]:
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


def first_order_index(ordered: FloatArray, result: FloatArray) -> VarianceIndex:
    """Return ``Var(E[y | x]) / Var(y)`` of a result y (n,) for a parameter in rising order (n,).

    The mean given x is a line in each of n^(1/3) groups of equal size, at most 8 below 4096
    samples (E. Plischke, E. Borgonovo, C. L. Smith, Eur. J. Oper. Res. 226, 536 (2013)), and one
    value for each of a list.
    """
    n = len(ordered)
    largest = float(np.max(np.abs(result), initial=0.0))
    if n < _FEWEST or ordered[0] == ordered[-1] or largest == 0:
        return NO_INDEX
    spread = result / largest - np.mean(result / largest)
    total = float(spread @ spread)
    if total <= n * _CONSTANT**2:
        return NO_INDEX
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
        fit, jumps = _lines(spread, _rank_ordered(ordered), starts)
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
    error = max(float(np.std(influence)) / n**0.5, least)
    return VarianceIndex(value=1 - unexplained - correction, error=error)


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
) -> ConditionalCurve:
    """Return the Strehl ratio (n,) in groups of a parameter, given in rising order (n,)."""
    n = len(ordered)
    discrete = is_list(ordered)
    if discrete:
        starts = value_starts(ordered)
    else:
        groups = next((k for limit, k in _GROUPS if n < limit), _MOST_GROUPS)
        starts = group_starts(ordered, groups)
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
