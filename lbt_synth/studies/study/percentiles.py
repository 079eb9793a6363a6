"""Means, percentiles and shares of samples, with their standard errors or confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.validation import BoolArray, FloatArray

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentile:
    """A percentile of a sample."""

    percent: float  # in [0, 100]
    value: float  # nan if there is no sample
    low: float  # of the 95 % interval of the true percentile; nan if the sample is too small
    high: float  # of the same interval, likewise


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    """A part of the samples."""

    count: int
    total: int  # all samples
    low: float  # of the 95 % interval of the true probability
    high: float  # of the same interval

    @property
    def value(self) -> float:
        """The part, in [0, 1]; nan if there is no sample."""
        return self.count / self.total if self.total else np.nan


def percentiles(values: FloatArray, percents: Sequence[float]) -> tuple[Percentile, ...]:
    """Return percentiles of a sample (n,), with intervals from order statistics."""
    from scipy.stats import binom

    n, tail = len(values), (1 - CONFIDENCE) / 2
    if n == 0:
        return tuple(Percentile(percent=p, value=np.nan, low=np.nan, high=np.nan) for p in percents)
    ordered = np.sort(values)
    limits = np.concatenate(([np.nan], ordered, [np.nan]))  # none before the first, after the last
    out = []
    for percent in percents:
        first = int(binom.ppf(tail, n, percent / 100))
        last = int(binom.ppf(1 - tail, n, percent / 100)) + 1
        value = _interpolate(ordered, percent / 100)
        low, high = limits[[max(first, 0), last]].tolist()
        out.append(Percentile(percent=percent, value=value, low=low, high=high))
    return tuple(out)


def _interpolate(ordered: FloatArray, fraction: float) -> float:
    """Return a quantile by linear interpolation between order statistics; some may be inf."""
    at = fraction * (len(ordered) - 1)
    below = int(at)
    low, weight = float(ordered[below]), at - below
    if weight == 0 or low == ordered[below + 1]:
        return low
    return low + weight * (float(ordered[below + 1]) - low)


def share(where: BoolArray) -> Share:
    """Return the part of the samples (n,) of a mask, with the interval of Clopper and Pearson."""
    from scipy.special import betaincinv

    count, total = int(np.count_nonzero(where)), len(where)
    if total == 0:
        return Share(count=0, total=0, low=np.nan, high=np.nan)
    tail = (1 - CONFIDENCE) / 2
    low = float(betaincinv(count, total - count + 1, tail)) if count else 0.0
    high = float(betaincinv(count + 1, total - count, 1 - tail)) if count < total else 1.0
    return Share(count=count, total=total, low=low, high=high)


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean and its standard error for independent samples; nan if too few."""
    n = len(values)
    mean = float(np.mean(values)) if n else np.nan
    return mean, float(np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else np.nan
