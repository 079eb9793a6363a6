"""The worst error of an estimator over an interval of frequencies: searched for, and bounded.

The two share no more than the error system. The search can only be too low. The bound can only
be too high: for the norm it is exact, by the envelope of all plants
(:meth:`FrequencyInterval.envelope`); for the variance it is a branch and bound with a bound on
the curvature.
"""

from __future__ import annotations

import heapq
from itertools import pairwise

import numpy as np
from scipy.optimize import fminbound

from lbt_synth.errors import NumericalError
from lbt_synth.linear import Controller, StateSpace, hinf_norm
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.norms import band_norm
from lbt_synth.models.plant.frequency_interval import FrequencyInterval

_GRID = 33
_GAP = 1e-4  # relative, between the bound of the variance and one that occurs
_MOST_PARTS = 20_000


def error_size(error: StateSpace, norm: str) -> float:
    """Norm ("hinf") or standard deviation ("h2") of a stable error."""
    if norm == "hinf":
        return hinf_norm(error).value
    covariance = stationary_covariance(error.A, error.B @ error.B.T)
    return float(np.sqrt(np.trace(error.C @ covariance @ error.C.T)))


def search_worst_error(
    interval: FrequencyInterval, estimator: Controller, norm: str
) -> tuple[float, float]:
    """Return the worst error on a grid of frequencies, refined, and where it is [Hz]."""

    def size(frequency_hz: float) -> float:
        a1 = interval.coefficient(frequency_hz)
        return error_size(interval.error_system(a1, estimator), norm)

    if interval.half_width_hz == 0:
        return size(interval.low_hz), interval.low_hz
    grid = np.linspace(interval.low_hz, interval.high_hz, _GRID)
    found = [(size(float(f)), float(f)) for f in grid]
    sizes = np.array([value for value, _ in found])
    beside = np.concatenate([[-np.inf], sizes, [-np.inf]])
    peaks = np.flatnonzero((sizes >= beside[:-2]) & (sizes > beside[2:]))
    for i in peaks[np.argsort(sizes[peaks])[-3:]]:
        around = grid[max(i - 1, 0)], grid[min(i + 1, _GRID - 1)]
        x, least, *_ = fminbound(lambda f: -size(float(f)), *around, xtol=1e-7, full_output=True)
        found.append((-float(least), float(x)))
    return max(found)


def bound_worst_error(interval: FrequencyInterval, estimator: Controller, norm: str) -> float:
    """Return a bound of the error on all of the interval."""
    if norm == "hinf":
        ends = [hinf_norm(interval.error_system(a, estimator)) for a in interval.coefficients]
        system, low_hz, high_hz = interval.envelope(estimator)
        return max(bound.upper for bound in (*ends, band_norm(system, low_hz, high_hz)))
    return float(np.sqrt(_greatest_variance(interval, estimator)))


def _greatest_variance(interval: FrequencyInterval, estimator: Controller) -> float:
    """Bound of the variance V(a1), from ``V'' >= -curvature V``.

    Between two points at a distance d the greatest V is at most the greater end over
    ``1 - curvature d^2 / 8``. The part with the greatest bound is halved until its bound is
    within 1e-4 of a variance that occurs.
    """

    def variance(a1: float) -> float:
        return error_size(interval.error_system(a1, estimator), "h2") ** 2

    low, high = interval.coefficients
    curvature = _curvature(interval)
    count = 1 + int(np.ceil((high - low) * np.sqrt(curvature / 4)))
    if count > _MOST_PARTS:
        raise _unbounded_error()
    ends = [(a, variance(a)) for a in np.linspace(low, high, count + 1).tolist()]
    best = max(value for _, value in ends)

    def part(a: float, b: float, at_a: float, at_b: float) -> tuple[float, ...]:
        bound = max(at_a, at_b) / (1 - curvature * (b - a) ** 2 / 8)
        return -bound, a, b, at_a, at_b

    parts = [part(a, b, at_a, at_b) for (a, at_a), (b, at_b) in pairwise(ends)]
    heapq.heapify(parts)
    for _ in range(_MOST_PARTS):
        bound, a, b, at_a, at_b = parts[0]
        if -bound <= best * (1 + _GAP):
            return -bound
        middle = (a + b) / 2
        at_middle = variance(middle)
        best = max(best, at_middle)
        heapq.heapreplace(parts, part(a, middle, at_a, at_middle))
        heapq.heappush(parts, part(middle, b, at_middle, at_b))
    raise _unbounded_error()


def _unbounded_error() -> NumericalError:
    return NumericalError(
        f"the variance over the interval is not bounded to {_GAP:g} with {_MOST_PARTS} parts: the "
        "vibration is too narrow a line for it. Try a narrower interval, or more damping.",
        status="branch and bound",
    )


def _curvature(interval: FrequencyInterval) -> float:
    """Greatest ``-V''/V`` of the variance as a function of a1.

    The vibration's spectrum at the angle t is in proportion to ``f = 1 / (u^2 + s^2)`` with
    ``u = a1 - (1 + r) cos t``, ``s = (1 - r) sin t`` and ``r = -a2``; nothing else of the variance
    depends on a1. ``-f''/f = (2 s^2 - 6 u^2) / (u^2 + s^2)^2`` is negative but for
    ``|u| < s / sqrt(3)``, where it is at most ``2 / s^2``; and s is least at the ends of the
    angles at which an a1 of the interval is so close.
    """
    kept = interval.retention
    low, high = interval.coefficients
    reach, tilt = (1 - kept) / np.sqrt(3), 1 + kept
    radius, lean = np.hypot(tilt, reach), np.arctan2(reach, tilt)
    first = np.arccos(high / radius) - lean
    last = np.arccos(low / radius) + lean
    least = (1 - kept) * min(np.sin(first), np.sin(last))
    return float(2 / least**2)
