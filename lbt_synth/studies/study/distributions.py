"""Distributions of parameters, by their inverse cumulative distribution functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import ndtr, ndtri

from lbt_synth.errors import ProblemError
from lbt_synth.validation import FloatArray

_EDGE = 2.0**-32  # no sample is nearer to the ends of (0, 1): the normal's would be infinite


class Distribution(Protocol):
    """What a parameter may be."""

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        ...

    @property
    def text(self) -> str:
        """Description for people."""
        ...

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values below which the shares ``level``, in [0, 1), of it lie."""
        ...

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the ends of what so many samples are expected to reach."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixed:
    """One value."""

    value: float

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        return False

    @property
    def text(self) -> str:
        """Description for people."""
        return f"fixed at {self.value:g}"

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the value for every level."""
        return np.full(np.shape(level), self.value)

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the value twice."""
        return self.value, self.value


@dataclass(frozen=True, slots=True, kw_only=True)
class Uniform:
    """Uniform between two ends."""

    low: float
    high: float

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        return True

    @property
    def text(self) -> str:
        """Description for people."""
        return f"uniform from {self.low:g} to {self.high:g}"

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values at levels in [0, 1)."""
        return np.clip(self.low + level * (self.high - self.low), self.low, self.high)

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the ends."""
        return self.low, self.high


@dataclass(frozen=True, slots=True, kw_only=True)
class Normal:
    """Normal, cut at ``low`` and ``high`` where they are finite.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies.study.distributions import Normal
    >>> Normal(mean=20, deviation=0.5).quantile(np.array([0.5, 0.8413447460685429])).round(6)
    array([20. , 20.5])
    >>> Normal(mean=20, deviation=0.5, low=20).quantile(np.array([0.0])).round(6)
    array([20.])
    """

    mean: float
    deviation: float
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        start, stop, _ = self._cut
        if not stop - start > 0:
            raise ProblemError(
                f"a normal distribution of mean {self.mean:g} and deviation {self.deviation:g} "
                f"has nothing between {self.low:g} and {self.high:g}."
            )

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        return True

    @property
    def text(self) -> str:
        """Description for people."""
        out = f"normal, {self.mean:g} with deviation {self.deviation:g}"
        if np.isfinite(self.low):
            out += f", from {self.low:g}"
        return out + (f", to {self.high:g}" if np.isfinite(self.high) else "")

    @property
    def _cut(self) -> tuple[float, float, float]:
        """Probabilities of the ends, and +1, or -1 if both count from above.

        Above the mean, 1 - F is what floating-point numbers resolve.
        """
        low, high = ((end - self.mean) / self.deviation for end in (self.low, self.high))
        if low > 0:
            return float(ndtr(-high)), float(ndtr(-low)), -1.0
        return float(ndtr(low)), float(ndtr(high)), 1.0

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values at levels in [0, 1)."""
        start, stop, sign = self._cut
        share = np.clip(level, _EDGE, 1 - _EDGE)
        share = share if sign > 0 else 1 - share
        standard = sign * ndtri(start + share * (stop - start))
        with np.errstate(over="ignore"):  # what is infinite is refused as a value
            found = self.mean + self.deviation * standard
        return np.clip(found, self.low, self.high)

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the ends, or where half a sample is expected beyond."""
        inside = self.quantile(np.array([0.5 / samples, 1 - 0.5 / samples]))
        low = self.low if np.isfinite(self.low) else float(inside[0])
        return low, self.high if np.isfinite(self.high) else float(inside[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed:
    """One of several values, by their weights.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.studies.study.distributions import Listed
    >>> Listed(values=(10, 20, 30), weights=(1, 1, 2)).quantile(np.array([0.2, 0.3, 0.5]))
    array([10., 20., 30.])
    """

    values: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        return len(self.values) > 1

    @property
    def text(self) -> str:
        """Description for people."""
        shown = [f"{value:g}" for value in self.values]
        if len(set(self.weights)) > 1:
            shown = [f"{v} ({w:g})" for v, w in zip(shown, self.weights, strict=True)]
        middle = ["..."] if len(shown) > 8 else []
        shown = shown if not middle else shown[:4] + middle + shown[-3:]
        return f"one of {', '.join(shown)}"

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values at levels in [0, 1)."""
        shares = np.array(self.weights) / max(self.weights)  # large ones add up to no infinity
        bounds = np.cumsum(shares) / np.sum(shares)
        index = np.searchsorted(bounds[:-1], level, side="right")
        return np.array(self.values, dtype=np.float64)[index]

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the least and the largest."""
        return min(self.values), max(self.values)


def median(distribution: Distribution) -> float:
    """Return the median."""
    return float(distribution.quantile(np.array([0.5]))[0])


def equal_weights(values: Sequence[float]) -> tuple[float, ...]:
    """Return a weight of 1 for each value."""
    return (1.0,) * len(values)
