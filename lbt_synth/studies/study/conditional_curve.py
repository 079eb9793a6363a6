"""The result given one parameter: a curve, and how far it goes up and down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.comparison import mean_and_error
from lbt_synth.studies.study.variance_index import group_starts, is_list, value_starts
from lbt_synth.validation import BoolArray, FloatArray, frozen

_GROUPS = ((200, 4), (1600, 8), (20_000, 16))  # so many groups below that many samples
_MOST_GROUPS = 32
_MIDDLE = 0.05, 0.95


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConditionalCurve:
    """Strehl ratio over one parameter, all others as they come."""

    parameter: FloatArray  # (k,): median of the parameter in each group, or the values of a list
    # low_edge, high_edge (k,): least and greatest value of the parameter in each group
    low_edge: FloatArray
    high_edge: FloatArray
    # mean, mean_error (k,): mean of the Strehl ratio in each group, and its standard error
    mean: FloatArray
    mean_error: FloatArray
    # low, high (k,): its 10th and 90th percentiles
    low: FloatArray
    high: FloatArray
    unstable: FloatArray  # (k,): part of the loops that are unstable
    samples: FloatArray  # (k,): samples in each group
    discrete: bool  # Whether the groups are the values of a list

    def swing(self) -> tuple[float, float]:
        """Greatest less least mean over the middle 90 % of the samples, and its standard error."""
        end = np.cumsum(self.samples)
        centre = (end - self.samples / 2) / end[-1]
        inside = self.discrete | ((centre >= _MIDDLE[0]) & (centre <= _MIDDLE[1]))
        places = np.flatnonzero(inside)
        top = places[np.argmax(self.mean[places])]
        bottom = places[np.argmin(self.mean[places])]
        error = np.hypot(self.mean_error[top], self.mean_error[bottom])
        return float(self.mean[top] - self.mean[bottom]), float(error)


def conditional_curve(
    ordered: FloatArray, strehl: FloatArray, unstable: BoolArray
) -> ConditionalCurve:
    """Mean, percentiles and instability of a result in groups of one parameter.

    Shapes: ordered (n,), strehl (n,), unstable (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies.study.conditional_curve import conditional_curve
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
    for first, last in zip(starts, np.append(starts[1:], n), strict=True):
        inside, here = ordered[first:last], strehl[first:last]
        low, high = np.percentile(here, (10, 90))
        mean, error = mean_and_error(here)
        rows.append(
            (
                (inside[(len(inside) - 1) // 2] + inside[len(inside) // 2]) / 2,
                inside[0],
                inside[-1],
                mean,
                error,
                low,
                high,
                np.mean(unstable[first:last]),
                last - first,
            )
        )
    columns = [frozen(values) for values in zip(*rows, strict=True)]
    parameter, low_edge, high_edge, means, errors, lows, highs, parts, samples = columns
    return ConditionalCurve(
        parameter=parameter,
        low_edge=low_edge,
        high_edge=high_edge,
        mean=means,
        mean_error=errors,
        low=lows,
        high=highs,
        unstable=parts,
        samples=samples,
        discrete=discrete,
    )
