"""Power spectra of sampled resonances, and their derivatives.

A second-order process of natural frequency f, damping ratio zeta and variance P, sampled at
f_s, is ``x(k+1) = a1 x(k) + a2 x(k-1) + v(k)``. With ``q = -a2``, ``b = 1 - a1 - a2`` and
``s = 4 sin^2(pi f / f_s)``::

    |1 - a1 z^-1 - a2 z^-2|^2 = (b - (1 + q) s / 2)^2 + (1 - q)^2 s (1 - s / 4)
    var v / P                 = (1 - q) b (2 (1 + q) - b) / (1 + q)

Both are sums and products without cancellation, down to any frequency and damping. A damping
ratio above 1 means two real poles; the formulas are smooth at 1.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import FloatArray

PARAMETERS = 3  # of a component: log frequency, log damping, log variance


def recursion(frequency: float, damping: float) -> tuple[float, float, FloatArray]:
    """Return b, 1 - q and their Jacobian (2, 2) by the logarithms of frequency and damping."""
    w, decay = frequency, damping * frequency
    rho = np.exp(-decay)
    p = -np.expm1(-2 * decay)
    square = (1 - damping) * (1 + damping)
    root = np.sqrt(abs(square))
    turn = w * root
    # half is rho (1 - cos(turn)), ratio is rho sin(turn) / root; two real poles where square < 0
    if square >= 0:
        half = 2 * rho * np.sin(turn / 2) ** 2
        ratio = rho * w * np.sinc(turn / np.pi)
        b = np.expm1(-decay) ** 2 + 2 * half
    else:
        slow = w / (damping + root)  # decay - turn without cancellation
        gaps = np.expm1(-slow), np.expm1(-decay - turn)
        difference = gaps[0] - gaps[1]
        half = -0.5 * (gaps[0] + gaps[1] - 2 * np.expm1(-decay))
        ratio = 0.5 * difference / root
        b = gaps[0] * gaps[1]
    by_decay = -2 * rho * np.expm1(-decay) - 2 * half  # of b, the turn held
    by_frequency = by_decay * decay + 2 * ratio * w * square
    by_damping = by_decay * decay - 2 * ratio * w * damping**2
    p_by_log = 2 * decay * (1 - p)
    return float(b), float(p), np.array([[by_frequency, by_damping], [p_by_log, p_by_log]])


def coefficients(frequency: float, damping: float) -> tuple[float, float, float]:
    """Return a1, a2 and var v / P of a sampled resonance."""
    b, p, _ = recursion(frequency, damping)
    q = 1 - p
    drive = p * b * (2 * (1 + q) - b) / (1 + q)
    if damping >= 1:
        return 1 - b + q, -q, drive
    decay = np.exp(-damping * frequency)
    turn = frequency * np.sqrt((1 - damping) * (1 + damping))
    return float(2 * decay * np.cos(turn)), -float(decay**2), drive


def coefficient_rows(frequency: FloatArray, damping: FloatArray) -> FloatArray:
    """Coefficients a1 and a2 of p sampled resonances, (p, 2)."""
    decay = np.exp(-damping * frequency)
    turn = frequency * np.sqrt((1 - damping) * (1 + damping))
    return np.stack([2 * decay * np.cos(turn), -(decay**2)], axis=-1)


def log_density(
    frequency: float, damping: float, s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Logarithm of the spectrum of unit variance, and its derivatives; all are (f,) as s is."""
    b, p, jacobian = recursion(frequency, damping)
    q = 1 - p
    near = b - (1 + q) / 2 * s
    wide = s * (1 - s / 4)
    size = near**2 + p**2 * wide
    drive = 2 * (1 + q) - b
    value = np.log(p * b * drive / ((1 + q) * size))
    by_b = (1 / b - 1 / drive) - 2 * near / size
    # by p = 1 - q, b held
    by_p = (1 / p - 2 / drive + 1 / (1 + q)) - (near * s + 2 * p * wide) / size
    return (
        value,
        by_b * jacobian[0, 0] + by_p * jacobian[1, 0],
        by_b * jacobian[0, 1] + by_p * jacobian[1, 1],
    )


def log_roll_off(corner: float, order: float, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Logarithm of the power response of low passes, ``order`` of first order, and its derivative.

    The derivative is by the logarithm of the corner; both are (f,) as s is.
    """
    gap, pole = -np.expm1(-corner), np.exp(-corner)
    size = gap**2 + pole * s
    slope = corner * pole * (2 / gap - (2 * gap - s) / size)
    return order * np.log(gap**2 / size), order * slope
