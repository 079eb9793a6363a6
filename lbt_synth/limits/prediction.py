"""What of a process cannot be known in time: the error of the best prediction.

With the measured spectrum ``Phi = S + R = |F|^2``, F outer, and the path ``z^-1 M`` from a
filter's output to the residual written as an inner factor times an outer one, the least
variance is that of the part of F which the inner factor makes unreachable, less R. The
inner factor is ``z^-whole``, and for a fraction of a frame above one half also an all-pass
factor with one zero; the unreachable part has as many coefficients as these have zeros.
All that is needed of F are integrals of ``log Phi`` times smooth weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.models.hardware import LoopHardware
from lbt_synth.validation import ComplexArray, FloatArray

_FEW_DIGITS = 1e-2  # a quotient by less than this would lose more than two digits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reach:
    """Inner factor of the path.

    Attributes
    ----------
    whole : int
        Frames of pure delay from the measured sample to the one that is corrected.
    zero : float
        Zero of the all-pass factor in the backward shift, in (-1, 0); 0 where there is none.
    terms : int
        Cosine integrals that are needed, the mean included.
    """

    whole: int
    zero: float
    terms: int

    @staticmethod
    def of(hardware: LoopHardware) -> Reach:
        """Inner factor of a loop's path."""
        taps = hardware.mirror_taps
        fraction = float(taps[-1]) if taps.size > 1 and taps[-2] > 0 else 0.0
        whole = taps.size - (1 if fraction > 0 else 0)
        if fraction <= 0.5:  # (1 - f) + f z^-1 has a stable inverse, at one half in the limit
            return Reach(whole=whole, zero=0.0, terms=whole)
        zero = -(1 - fraction) / fraction
        if abs(zero) ** whole > _FEW_DIGITS:
            return Reach(whole=whole, zero=zero, terms=whole)
        # the quotient (F - f_0 - ...) / zero^whole as a series
        more = int(np.ceil(np.log(1e-17) / np.log(max(abs(zero), 1e-300))))
        return Reach(whole=whole, zero=zero, terms=whole + 1 + more)

    @property
    def by_series(self) -> bool:
        """Whether the value at the zero is summed from its series."""
        return self.terms > self.whole

    def weights(self, x: FloatArray) -> FloatArray:
        """Weights (f, k) of the logarithm at frequencies x, in units of Nyquist."""
        columns = [np.cos(np.pi * n * x) for n in range(self.terms)]
        if self.zero != 0 and not self.by_series:
            shifted = self.zero * np.exp(-1j * np.pi * x)
            columns.append(np.real(shifted / (1 - shifted)))
        return np.stack(columns, axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """Best prediction of a process whose spectrum has given integrals of its logarithm.

    Attributes
    ----------
    reach : Reach
        Inner factor of the path.
    mean_log : float
        Mean of ``log(Phi / reference)``.
    coefficients : (whole,) ndarray
        ``1, f_1, ...`` of ``F = sigma (1 + f_1 z^-1 + ...)``.
    tail : float
        Value at the zero of the all-pass factor of what follows them.
    """

    reach: Reach
    mean_log: float
    coefficients: FloatArray
    tail: float

    @staticmethod
    def of(reach: Reach, moments: FloatArray) -> Prediction:
        """From the integrals of the logarithm times the weights of a reach."""
        f = _exponential(moments[: reach.terms])
        a, whole = reach.zero, reach.whole
        tail = 0.0
        if a != 0 and reach.by_series:
            tail = float(np.polynomial.polynomial.polyval(a, f[whole:]))
        elif a != 0:
            known = float(np.polynomial.polynomial.polyval(a, f[:whole]))
            tail = (float(np.exp(moments[-1])) - known) / a**whole
        return Prediction(
            reach=reach, mean_log=float(moments[0]), coefficients=f[:whole], tail=tail
        )

    @property
    def later_power(self) -> float:
        """Sum of squares of all unreachable coefficients but the first, over sigma^2."""
        later = float(np.sum(self.coefficients[1:] ** 2))
        return later + (1 - self.reach.zero**2) * self.tail**2

    def variance(self, reference: float, noise: float) -> float:
        """Least variance of the residual; the reference is the noise unless that is zero."""
        sigma2 = np.exp(self.mean_log)
        if noise > 0:  # sums of positive numbers: no digits are lost however large the noise
            return float(reference * (np.expm1(self.mean_log) + sigma2 * self.later_power))
        return float(reference * sigma2 * (1 + self.later_power))

    def error_power(self, x: FloatArray) -> FloatArray:
        """``|P|^2 / sigma^2`` at frequencies x: the rejection is ``|P / F|^2``."""
        shift = np.exp(-1j * np.pi * x)
        part: ComplexArray = np.asarray(
            np.polynomial.polynomial.polyval(shift, self.coefficients), dtype=np.complex128
        )
        a = self.reach.zero
        if a != 0:
            part = part + self.tail * (1 - a**2) * shift**self.reach.whole / (1 - a * shift)
        return np.asarray(np.abs(part) ** 2)


def _exponential(c: FloatArray) -> FloatArray:
    """Coefficients of ``exp(c_1 x + c_2 x^2 + ...)``, as many as there are c."""
    f = np.zeros(c.size)
    f[0] = 1.0
    weighted = np.arange(c.size) * c
    for n in range(1, c.size):
        f[n] = weighted[1 : n + 1] @ f[n - 1 :: -1][:n] / n
    return f
