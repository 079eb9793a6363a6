"""The part of a result's variance that one parameter explains, estimated from given samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.validation import FloatArray, IntArray

FEWEST = 20  # samples for an index
_VALUES = 32  # distinct values of a list, at most
_COARSE = 8, 4096  # intervals, at most, with fewer than that many samples


@dataclass(frozen=True, slots=True, kw_only=True)
class VarianceIndex:
    """First-order index of one parameter."""

    value: float  # about 0 without an effect; nan if the result or the parameter is constant
    error: float  # standard error for independent samples; too large for more even ones
    correction: float  # subtracted for the scatter of the fit
    groups: int  # values of a list, or intervals of a continuous parameter


NO_INDEX = VarianceIndex(value=np.nan, error=np.nan, correction=np.nan, groups=0)


def is_list(ordered: FloatArray) -> bool:
    """Whether a parameter, given in rising order, takes few values only."""
    distinct = 1 + int(np.count_nonzero(np.diff(ordered)))
    return distinct <= min(_VALUES, max(2, len(ordered) // 5))


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
    the jumps between neighbouring lines, of variance ``8 s^2 B / n``, tell how much.

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
    if is_list(ordered):
        starts = value_starts(ordered)
        coefficients = len(starts)
        rest, ends = spread - _means(spread, starts), None
    else:
        groups = round(n ** (1 / 3))
        starts = group_starts(n, groups if n >= _COARSE[1] else min(groups, _COARSE[0]))
        coefficients = 2 * len(starts)
        fit, ends = _lines(spread, starts)
        rest = spread - fit
    squares = rest * rest
    unexplained = float(np.sum(squares)) / total
    if n <= coefficients:
        return NO_INDEX
    scatter = float(np.sum(squares)) / (n - coefficients)
    if ends is not None:
        jumps = ends[0][1:] - ends[1][:-1]
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


def _lines(
    values: FloatArray, starts: IntArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Return a line fitted to each group, at every sample and at either end of the group."""
    n = len(values)
    counts = np.diff(np.append(starts, n))
    middle = starts + (counts - 1) / 2
    place = (np.arange(n) - np.repeat(middle, counts)) / np.repeat(counts / 2, counts)
    means = np.add.reduceat(values, starts) / counts
    slopes = np.add.reduceat(place * values, starts) / np.add.reduceat(place * place, starts)
    fit = np.repeat(means, counts) + np.repeat(slopes, counts) * place
    return fit, (means - slopes, means + slopes)
