"""Distributions of a study's parameters, by their quantiles."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from lbt_synth.errors import ProblemError
from lbt_synth.validation import FloatArray

_EDGE = 2.0**-32  # levels stay this far from 0 and 1, where a normal quantile is infinite


class Distribution(ABC):
    """Distribution of a parameter."""

    __slots__ = ()

    @property
    def varies(self) -> bool:
        """Whether it takes a dimension of the sampling."""
        return True

    @property
    @abstractmethod
    def text(self) -> str:
        """Description for people."""

    @abstractmethod
    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the value below which each share ``level``, in [0, 1), of it lies."""

    @abstractmethod
    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the least and greatest value that so many samples are expected to reach."""

    def median(self) -> float:
        """Return the median."""
        return float(self.quantile(np.array([0.5]))[0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixed(Distribution):
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
class Uniform(Distribution):
    """Uniform between two ends."""

    low: float
    high: float

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
class Normal(Distribution):
    """Normal, cut at ``low`` and ``high`` if they are finite.

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
    def text(self) -> str:
        """Description for people."""
        out = f"normal, {self.mean:g} with deviation {self.deviation:g}"
        if np.isfinite(self.low):
            out += f", from {self.low:g}"
        return out + (f", to {self.high:g}" if np.isfinite(self.high) else "")

    @property
    def _cut(self) -> tuple[float, float, float]:
        """Probabilities of the ends, and +1, or -1 if both count from above.

        Floating-point numbers resolve 1 - F above the mean, and F below.
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
        with np.errstate(over="ignore"):  # an infinite value is refused later
            found = self.mean + self.deviation * standard
        return np.clip(found, self.low, self.high)

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the ends, or levels beyond which half a sample is expected."""
        inside = self.quantile(np.array([0.5 / samples, 1 - 0.5 / samples]))
        low = self.low if np.isfinite(self.low) else float(inside[0])
        return low, self.high if np.isfinite(self.high) else float(inside[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed(Distribution):
    """One of several values, chosen by weight.

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
        if len(shown) > 8:
            shown[4:-3] = ["..."]
        return f"one of {', '.join(shown)}"

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return the values at levels in [0, 1)."""
        shares = np.array(self.weights) / max(self.weights)  # so that their sum cannot overflow
        bounds = np.cumsum(shares) / np.sum(shares)
        index = np.searchsorted(bounds[:-1], level, side="right")
        return np.array(self.values, dtype=np.float64)[index]

    def extremes(self, samples: int) -> tuple[float, float]:
        """Return the least and the largest."""
        return min(self.values), max(self.values)
