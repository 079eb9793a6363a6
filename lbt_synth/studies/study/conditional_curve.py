"""Strehl ratio as a function of one parameter: its curve and its swing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.studies.study.comparison import mean_and_error
from lbt_synth.studies.study.variance_index import group_starts, is_list, value_starts
from lbt_synth.validation import BoolArray, FloatArray, frozen_copy

_GROUPS = ((200, 4), (1600, 8), (20_000, 16))  # samples, and groups if there are fewer
_MOST_GROUPS = 32
_MIDDLE = 0.05, 0.95


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
        """Return greatest less least mean over the middle 90 % of samples, and its error."""
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
    """Return the Strehl ratio (n,) in groups of a parameter, given in rising order (n,).

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
            {
                "parameter": (inside[(len(inside) - 1) // 2] + inside[len(inside) // 2]) / 2,
                "low_edge": inside[0],
                "high_edge": inside[-1],
                "mean": mean,
                "mean_error": error,
                "low": low,
                "high": high,
                "unstable": np.mean(unstable[first:last]),
                "samples": last - first,
            }
        )
    columns = {name: frozen_copy([row[name] for row in rows]) for name in rows[0]}
    return ConditionalCurve(**columns, discrete=discrete)
