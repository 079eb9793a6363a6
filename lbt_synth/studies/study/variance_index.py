"""First-order index of a parameter: the part of a result's variance that it explains by itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.validation import FloatArray, IntArray

FEWEST = 20  # samples for an index
_MOST_VALUES = 32  # a parameter with more distinct values is continuous
_MOST_INTERVALS = 8  # with fewer samples than _MANY_SAMPLES
_MANY_SAMPLES = 4096
_FEWEST_OF_LINE = 3  # samples on either side of an edge
_CLEAR = 20.0  # F-value of an edge, beyond what chance gives some thousand intervals
_ROUNDING = 1e-12
_CONSTANT = 1e-12  # of the largest result, the scatter of one that is constant
_EVEN = 0.5  # of what independent samples scatter about their mean, where those of a list are even


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
        The results, in the same order; those of one value of a list in the order of the samples.

    Returns
    -------
    VarianceIndex
        The index.

    Raises
    ------
    ProblemError
        If a result is not finite.

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
    the jumps between neighbouring lines, of variance ``8 s^2 B / n``, tell how much, and of a list
    the means of the two halves of each value. Where two lines fit an interval clearly better than
    one (by an F-test, without the sample farthest from one line, too), it is parted in two: a loop
    that becomes unstable beyond some value of x leaves an edge.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies import first_order_index
    >>> x = (np.arange(1000) + 0.5) / 1000
    >>> round(first_order_index(x, x).value, 6)
    1.0
    """
    n = len(ordered)
    if not np.isfinite(result).all():
        raise ProblemError("result must be finite; leave out the samples that have none.")
    largest = float(np.max(np.abs(result), initial=0.0))
    if n < FEWEST or ordered[0] == ordered[-1] or largest == 0:
        return NO_INDEX
    spread = result / largest - np.mean(result / largest)
    total = float(spread @ spread)
    if total <= n * _CONSTANT**2:
        return NO_INDEX
    is_discrete = is_list(ordered)
    if is_discrete:
        starts = value_starts(ordered)
        coefficients = len(starts)
        fit = _means(spread, starts)
        even = _half_scatter(spread, starts)
    else:
        groups = round(n ** (1 / 3))
        starts = group_starts(n, groups if n >= _MANY_SAMPLES else min(groups, _MOST_INTERVALS))
        edges = _edges(spread, starts)
        starts = np.sort(np.concatenate([starts, edges]))
        coefficients = 2 * len(starts) + len(edges)
        fit, jumps = _lines(spread, starts)
        jumps = jumps[~np.isin(starts[1:], edges)]
        even = float(np.mean(jumps**2)) / 8 * n / len(starts)
    rest = spread - fit
    squares = rest * rest
    unexplained = float(np.sum(squares)) / total
    scatter = float(np.sum(squares)) / (n - coefficients)
    if even < scatter * (_EVEN if is_discrete else 1.0):  # what even samples scatter is less
        scatter = even
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


def _half_scatter(values: FloatArray, starts: IntArray) -> float:
    """Return the scatter of single samples by the means of both halves of each group.

    Even samples scatter less about the mean of a group than independent ones would.
    """
    counts = np.diff(np.append(starts, len(values)))
    halves = counts // 2
    cuts = np.column_stack([starts, starts + halves])[halves > 0]
    sizes = np.column_stack([halves, counts - halves])[halves > 0]
    total = np.append(0.0, np.cumsum(values))
    first = (total[cuts[:, 1]] - total[cuts[:, 0]]) / sizes[:, 0]
    second = (total[cuts[:, 0] + sizes.sum(axis=1)] - total[cuts[:, 1]]) / sizes[:, 1]
    return float(np.mean((first - second) ** 2 / np.sum(1 / sizes, axis=1)))


def _edges(values: FloatArray, starts: IntArray) -> IntArray:
    """Return where to part the groups that two lines fit clearly better than one."""
    edges = []
    for start, group in zip(starts, np.split(values, starts[1:]), strict=True):
        m = len(group)
        least = max(_FEWEST_OF_LINE, m // 32)
        squares = _split_squares(group)
        inside = squares[least : m - least + 1]
        if inside.size == 0:
            continue
        best = least + int(np.argmin(inside))
        if not _is_clear(group, squares, best):
            continue
        one, _ = _lines(group, np.zeros(1, dtype=np.int64))
        farthest = int(np.argmax(np.abs(group - one)))  # a single one makes no edge
        rest = np.delete(group, farthest)
        if _is_clear(rest, _split_squares(rest), best - (farthest < best)):
            edges.append(int(start) + best)
    return np.array(edges, dtype=np.int64)


def _split_squares(group: FloatArray) -> FloatArray:
    """Return the squares about two lines that meet before sample k, of one at the end, (m + 1,)."""
    before, after = _line_squares(group), _line_squares(group[::-1])[::-1]
    squares: FloatArray = np.append(0.0, before) + np.append(after, 0.0)
    return squares


def _is_clear(group: FloatArray, squares: FloatArray, split: int) -> bool:
    """Whether two lines that meet before a sample fit a group clearly better than one."""
    gained = float(squares[-1] - squares[split])
    enough = gained * (len(group) - 4) > 2 * _CLEAR * squares[split]
    return bool(enough and gained > _ROUNDING * float(group @ group))


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
