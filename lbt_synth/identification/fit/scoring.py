"""Minima of a likelihood by scoring: Newton's method with the expected information.

Each step is the best one of the quadratic form within a trust region (J. Nocedal, S. Wright,
Numerical Optimization, 2nd ed. (2006), section 4.3). What the full step would gain, half the
gradient's square in the metric of the inverse information, says how far the minimum is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from lbt_synth.validation import FloatArray, IntArray

SEARCHED, EXACT = 1e-2, 1e-5  # log-likelihood that a step may still gain where a fit ends
_FARTHEST = 60.0  # of a logarithm: exp stays finite
_LEAST_INFORMATION = 1e-6  # of a parameter: a step is finite where the data say nothing
_RADIUS, _LARGEST_RADIUS = 1.0, 8.0  # of the trust region
MOST_STEPS = 40
_ACCEPTED, _POOR, _GOOD = 0.15, 0.25, 0.75  # of what a step should gain
_ALONG = 1e-4  # cosine below which a secant says nothing
_WITHIN = 0.99  # of the radius: a longer step ends at it
_HOPE = 4.0  # times what a full step gains, a fit may still gain


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Priors:
    """Normal priors on the packed parameters: a width of infinity is none, 0 fixes one."""

    centre: FloatArray  # (p,): means
    width: FloatArray  # (p,): standard deviations
    bounds: tuple[FloatArray | float, FloatArray | float] = (-_FARTHEST, _FARTHEST)  # (p,) each

    @property
    def free(self) -> IntArray:
        """Places of the parameters that a fit varies."""
        return np.flatnonzero(self.width > 0)


def scoring_minimum(
    differentiate: Callable[[FloatArray], tuple[float, FloatArray, FloatArray]],
    start: FloatArray,
    priors: Priors,
    *,
    bound: float = float("inf"),
    accuracy: float = EXACT,
) -> tuple[FloatArray, FloatArray] | None:
    """Minimise a contrast of the free parameters and their priors, within bounds.

    ``differentiate`` returns the contrast, its gradient and its information matrix. Return the
    parameters (free,) and the information (free, free); None if the contrast is not finite, or
    where it is unlikely to fall below ``bound``.
    """
    free = priors.free
    centre, precision = priors.centre[free], 1 / priors.width[free] ** 2
    low, high = (np.broadcast_to(ends, priors.width.shape)[free] for ends in priors.bounds)

    def evaluate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        value, gradient, information = differentiate(x)
        away = x - centre
        return (
            value + 0.5 * float(np.sum(precision * away**2)),
            gradient + precision * away,
            information + np.diag(precision + _LEAST_INFORMATION),
        )

    x, radius = np.clip(start, low, high), _RADIUS
    value, gradient, information = evaluate(x)
    rest = np.zeros_like(information)  # of the second derivatives
    for _ in range(MOST_STEPS):
        if not (np.isfinite(value) and np.all(np.isfinite(information))):
            return None
        curvature, slope = information + rest, gradient
        stays = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))  # at a bound
        if np.any(stays):
            curvature[stays] = curvature[:, stays] = 0
            curvature[stays, stays], slope = 1, np.where(stays, 0, slope)
        step, gain, expected = _best_step(curvature, slope, radius)
        if gain < accuracy:
            break
        size = float(np.linalg.norm(step))
        if value - _HOPE * gain > bound and size < _WITHIN * radius:
            return None  # a whole step, which can be trusted
        trial = np.clip(x + step, low, high)
        made = evaluate(trial)
        if np.isfinite(made[0]):
            between = 0.5 * (information + made[2])
            rest = rest + _secant(made[1] - gradient - (between + rest) @ (trial - x), trial - x)
        gained = (value - made[0]) / expected
        if not gained > _POOR:
            radius = 0.25 * min(radius, size)
        elif gained > _GOOD and size > _WITHIN * radius:
            radius = min(2 * radius, _LARGEST_RADIUS)
        if gained > _ACCEPTED:
            x, (value, gradient, information) = trial, made
    return x, information


def _best_step(
    curvature: FloatArray, gradient: FloatArray, radius: float
) -> tuple[FloatArray, float, float]:
    """Return the step (p,) that minimises a quadratic form within a radius, and two gains.

    The first is that of the minimum without a radius, the second that of this step. The curvature
    (p, p) counts by its absolute value.
    """
    whole, info = dposv(curvature, -gradient)[1:]
    if info == 0 and float(np.linalg.norm(whole)) <= radius:
        gain = -0.5 * float(gradient @ whole)
        return whole, gain, gain
    size, axes = np.linalg.eigh(curvature)
    size, slope = np.maximum(np.abs(size), _LEAST_INFORMATION), gradient @ axes
    step = _trust_step(slope, size, radius)
    gain = 0.5 * float(np.sum(slope**2 / size))
    return axes @ step, gain, -float(slope @ step + 0.5 * step @ (size * step))


def _secant(missing: FloatArray, step: FloatArray) -> FloatArray:
    """Return the symmetric rank-one matrix that maps a step to ``missing``; 0 if nearly normal."""
    along = float(missing @ step)
    least = _ALONG * float(np.linalg.norm(missing) * np.linalg.norm(step))
    return np.outer(missing, missing) / along if abs(along) > least else np.zeros((step.size,) * 2)


def _trust_step(slope: FloatArray, curvature: FloatArray, radius: float) -> FloatArray:
    """Return the step (p,) to the minimum of a quadratic form within a radius, in its axes."""
    more = 0.0
    for _ in range(MOST_STEPS):
        step = -slope / (curvature + more)
        size = float(np.linalg.norm(step))
        if size <= 1.001 * radius:
            break
        # Newton's method for 1 / size = 1 / radius, from below
        more += size**2 / float(np.sum(step**2 / (curvature + more))) * (size / radius - 1)
    return step
