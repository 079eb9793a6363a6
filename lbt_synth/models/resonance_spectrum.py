"""Power spectra of sampled resonances, and their derivatives.

A second-order process of natural frequency f, damping ratio zeta and variance P, sampled at
f_s, is ``x(k+1) = a1 x(k) + a2 x(k-1) + v(k)``. With ``q = -a2``, ``b = 1 - a1 - a2`` and
``s = 4 sin^2(pi f / f_s)``::

    |1 - a1 z^-1 - a2 z^-2|^2 = (b - (1 + q) s / 2)^2 + (1 - q)^2 s (1 - s / 4)
    var v / P                 = (1 - q) b (2 (1 + q) - b) / (1 + q)

Both are sums and products without cancellation, down to any frequency and damping. A damping
ratio above 1 means two real poles; the formulas are smooth at 1.

A bump is a process of m such sections in series. Its spectrum of unit variance is ``U^m / M``, U
that of one section and ``M = (1 / pi) int U^m dw`` over the angles w per frame from 0 to pi.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TypeVar

import numpy as np

from lbt_synth.linear.quadrature import legendre_rule
from lbt_synth.validation import FloatArray

PARAMETERS = 3  # of a component: log frequency, log damping, log variance
WIDE_DAMPING = 0.1  # damping ratio of a resonance that is no line
_NODES = 96  # of the integral over a bump, which then has 12 digits
Jacobian = tuple[tuple[float, float], tuple[float, float]]
Number = TypeVar("Number", float, FloatArray)


def recursion(frequency: float, damping: float) -> tuple[float, float, Jacobian]:
    """Return b, 1 - q and their Jacobian (2, 2) by the logarithms of frequency and damping."""
    w, decay = float(frequency), float(damping * frequency)
    rho = math.exp(-decay)
    p = -math.expm1(-2 * decay)
    square = (1 - damping) * (1 + damping)
    root = math.sqrt(abs(square))
    turn = w * root
    # half is rho (1 - cos(turn)), ratio is rho sin(turn) / root; two real poles where square < 0
    if square >= 0:
        half = 2 * rho * math.sin(turn / 2) ** 2
        ratio = rho * w * (math.sin(turn) / turn if turn else 1.0)
        b = math.expm1(-decay) ** 2 + 2 * half
    else:
        slow = w / (damping + root)  # decay - turn without cancellation
        gaps = math.expm1(-slow), math.expm1(-decay - turn)
        difference = gaps[0] - gaps[1]
        half = -0.5 * (gaps[0] + gaps[1] - 2 * math.expm1(-decay))
        ratio = 0.5 * difference / root
        b = gaps[0] * gaps[1]
    by_decay = -2 * rho * math.expm1(-decay) - 2 * half  # of b, the turn held
    by_frequency = by_decay * decay + 2 * ratio * w * square
    by_damping = by_decay * decay - 2 * ratio * w * damping**2
    p_by_log = 2 * decay * (1 - p)
    return b, p, ((by_frequency, by_damping), (p_by_log, p_by_log))


def drive_ratio(frequency: float, damping: float) -> float:
    """Return var v / P of a sampled resonance."""
    return _drive(*recursion(frequency, damping)[:2])


def coefficient_rows(frequency: FloatArray, damping: FloatArray) -> FloatArray:
    """Coefficients a1 and a2 of p sampled resonances, (p, 2); with two real poles above 1."""
    decay = np.exp(-damping * frequency)
    root = np.sqrt(np.abs((1 - damping) * (1 + damping)))
    slow, fast = frequency / (damping + root), frequency * (damping + root)
    poles = np.where(
        damping < 1, 2 * decay * np.cos(frequency * root), np.exp(-slow) + np.exp(-fast)
    )
    squares = decay**2
    # what rounding hides is nothing: a coefficient of 1e-37 has states that no solver can scale
    squares = np.where(squares < np.finfo(float).eps, 0.0, squares)
    return np.stack([poles, 0.0 - squares], axis=-1)


def unit_densities(
    frequency: Sequence[float], damping: Sequence[float], s: FloatArray, sections: Sequence[int]
) -> FloatArray:
    """Spectra of unit variance of c resonances, each of some sections in series, (c, f)."""
    b, p = np.array([recursion(*pair)[:2] for pair in zip(frequency, damping, strict=True)]).T[
        ..., None
    ]
    size = s * ((p - 2) / 2)
    size += b
    size *= size
    size += p**2 * (s * (1 - s / 4))
    density = np.asarray(_drive(b, p) / size)
    for i, m in enumerate(sections):
        if m > 1:
            density[i] **= m
            density[i] /= series_variance(frequency[i], damping[i], m)[0]
    return density


@lru_cache(maxsize=512)
def series_variance(
    frequency: float, damping: float, sections: int
) -> tuple[float, tuple[float, float]]:
    """Return M of sections in series, and its logarithm's slopes by log frequency and log damping.

    The substitution ``w = frequency (1 + damping tan x)`` makes the integrand smooth.
    """
    nodes, weights = legendre_rule(_NODES)
    width = damping * frequency
    low, high = math.atan(-1 / damping), math.atan((math.pi - frequency) / width)
    x = low + (high - low) * (nodes + 1) / 2
    s = 4 * np.sin((frequency + width * np.tan(x)) / 2) ** 2
    one = np.ones(1)
    density, slopes = resonance_densities(frequency * one, damping * one, one, s)
    share = (high - low) / 2 * weights * width / np.cos(x) ** 2 / math.pi * density[0] ** sections
    variance = float(np.sum(share))
    by_frequency, by_damping = (sections * slopes[0] @ share / variance).tolist()
    return variance, (by_frequency, by_damping)


def section_drives(frequency: float, damping: float, sections: int) -> FloatArray:
    """Return the driving deviations of processes of 1, 2, ... sections of unit variance, (m,)."""
    drive = drive_ratio(frequency, damping)
    variances = [series_variance(frequency, damping, m)[0] for m in range(1, sections + 1)]
    return np.asarray(np.sqrt(drive ** np.arange(1, sections + 1) / np.array(variances)))


def resonance_densities(
    frequency: FloatArray,
    damping: FloatArray,
    variance: FloatArray,
    s: FloatArray,
    sections: Sequence[int] = (),
) -> tuple[FloatArray, FloatArray]:
    """Spectra of c resonances, (c, f), with their logarithmic slopes (c, 2, f).

    The slopes are those of the logarithm by the logarithms of frequency and damping ratio; s is
    (f,). Those of several sections have their number in ``sections`` (c,), all 1 by default.
    """
    recursions = [
        recursion(*pair) for pair in zip(frequency.tolist(), damping.tolist(), strict=True)
    ]
    b, p = np.array([row[:2] for row in recursions]).T[..., None]
    by_b, by_p = np.array([row[2] for row in recursions]).transpose(1, 0, 2)  # by the logarithms
    half, wide = (2 - p) / 2, s * (1 - s / 4)
    near = s * -half
    near += b
    over = near * near
    over += p**2 * wide
    np.reciprocal(over, out=over)
    # s near = (b near - near^2) / half, and near^2 over = 1 - p^2 wide over
    shapes = np.ones((b.size, 3, s.size))
    np.multiply(near, over, out=shapes[:, 1])
    np.multiply(wide, over, out=shapes[:, 2])
    rest = 2 * (2 - p) - b
    top = (1 / b - 1 / rest) * by_b + (1 / p - 2 / rest + 1 / (2 - p)) * by_p  # of the numerator
    falls = [top + by_p / half, -2 * by_b - b / half * by_p, -2 * p / half * by_p]
    slopes = np.stack(falls, axis=2) @ shapes
    over *= _drive(b, p)
    for i, m in enumerate(sections):
        if m > 1:
            mean, by_log = series_variance(float(frequency[i]), float(damping[i]), m)
            over[i] **= m
            over[i] /= mean
            slopes[i] *= m
            slopes[i] -= np.array(by_log)[:, None]
    over *= variance[:, None]
    return over, slopes


def _drive(b: Number, p: Number) -> Number:
    """Variance of the driving noise of a resonance of unit variance."""
    return p * b * (2 * (2 - p) - b) / (2 - p)


def log_roll_off(corner: float, order: float, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Logarithm of the power response of low passes, ``order`` of first order, and its derivative.

    The derivative is by the logarithm of the corner; both are (f,) as s is.
    """
    gap, pole = -np.expm1(-corner), np.exp(-corner)
    size = gap**2 + pole * s
    slope = corner * pole * (2 / gap - (2 * gap - s) / size)
    return order * np.log(gap**2 / size), order * slope
