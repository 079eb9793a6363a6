"""The best prediction of a process through a loop's delay, and its error.

With the measured spectrum ``Phi = S + R = |F|^2``, F outer, and the path ``z^-1 M`` from a
filter's output to the residual written as an inner factor times an outer one, the least
variance is that of the part of F which the inner factor makes unreachable, less R. The
inner factor is ``z^-whole`` times an all-pass factor with the mirror's zeros outside the unit
circle: one for a settled mirror and a fraction of a frame above one half, one or two for a
mirror that moves slowly. The unreachable part has as many coefficients as these have zeros.
All that is needed of F are integrals of ``log Phi`` times smooth weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.linalg import toeplitz

from lbt_synth.errors import ProblemError
from lbt_synth.models import LoopHardware
from lbt_synth.validation import ComplexArray, FloatArray

_FEW_DIGITS = 1e-2  # a division by less than this would lose more than two digits
POINTS = 16  # samples on each side of one between two samples
_INDEPENDENT = 1e-13  # part of the largest eigenvalue of a covariance that is more than rounding
_REAL = 1e-7  # relative imaginary part of what counts as a real zero
_ALIKE = 1e9  # condition of the zeros' Gram matrix beyond which they count as equal


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InnerFactor:
    """The inner factor of a loop's path: a pure delay and an all-pass factor."""

    whole: int  # frames of pure delay from the measured sample to the corrected one
    zeros: tuple[float, ...]  # of the all-pass factor in the backward shift, in (-1, 1)
    terms: int  # number of cosine integrals that are needed, the mean included
    target: Interpolation | None = None  # what is corrected, where it is not one sample

    @staticmethod
    def of(hardware: LoopHardware, *, in_image: bool) -> InnerFactor:
        """Return the inner factor of a loop's path to the image, or to means over frames.

        In the image a command of a settled mirror corrects the mean over its own hold, whatever
        part of a frame it comes late by.
        """
        if in_image:
            if hardware.mirror is not None:
                raise ProblemError(
                    "the limit in the image is known for a mirror that settles at once; got one "
                    "with dynamics."
                )
            whole = int(hardware.delay_frames)
            if hardware.delay_frames == whole:
                return InnerFactor(whole=whole, zeros=(), terms=whole)
            return InnerFactor(whole=whole, zeros=(), terms=2 * POINTS)
        mirror = hardware.mirror_system
        found = mirror.core.zeros
        late = found[np.abs(found) > 1]  # on the circle: a stable inverse, in the limit
        whole = mirror.lead + 1
        if np.any(np.abs(late.imag) > _REAL * np.abs(late)):
            raise ProblemError(
                "the limit of a mirror is known for real zeros outside the unit circle; got "
                f"complex ones at {late[np.argmax(np.abs(late.imag))]:.6g}. Try another delay "
                "or frame rate, or the residual of lqg."
            )
        zeros = tuple(sorted(float(a) for a in 1 / late.real))
        if len(zeros) > 1 and np.linalg.cond(_gram(zeros)) > _ALIKE:
            raise ProblemError(
                "the limit of a mirror needs zeros outside the unit circle that differ; got "
                f"{', '.join(f'{1 / a:.9g}' for a in zeros)}. Try another delay or frame rate."
            )
        # for small zeros, the quotient (F - f_0 - ...) / zero^whole is summed as a series
        small = [abs(a) for a in zeros if abs(a) ** whole <= _FEW_DIGITS]
        more = 1 + int(np.ceil(np.log(1e-17) / np.log(max(*small, 1e-300)))) if small else 0
        return InnerFactor(whole=whole, zeros=zeros, terms=whole + more)

    @property
    def by_weight(self) -> tuple[float, ...]:
        """Zeros at which the value is an integral with a weight of its own."""
        return tuple(a for a in self.zeros if abs(a) ** self.whole > _FEW_DIGITS)

    def weights(self, x: FloatArray) -> FloatArray:
        """Weights (f, k) of the logarithm at frequencies x, in units of Nyquist."""
        columns = [np.cos(np.pi * n * x) for n in range(self.terms)]
        for a in self.by_weight:
            shifted = a * np.exp(-1j * np.pi * x)
            columns.append(np.real(shifted / (1 - shifted)))
        return np.stack(columns, axis=-1)


def _gram(zeros: tuple[float, ...]) -> FloatArray:
    """Inner products of the kernels ``1 / (1 - a z^-1)``."""
    a = np.array(zeros)
    return np.asarray(1 / (1 - np.outer(a, a)))


@dataclass(frozen=True, slots=True, eq=False)
class Interpolation:
    """A sample between two others, as the best sum over those around it: ``sum p[i] m(k + i)``.

    What the sum misses is orthogonal to the samples, so that nobody predicts it.
    """

    first: int  # first sample of the sum
    weights: FloatArray  # (2 POINTS,)
    missed: float  # variance of what the sum misses

    @staticmethod
    def lags(samples: float) -> FloatArray:
        """Return the lags of which :meth:`of` takes the covariances: of the samples, then to it."""
        first = int(samples) - POINTS + 1
        return np.concatenate([np.arange(2 * POINTS), samples - first - np.arange(2 * POINTS)])

    @staticmethod
    def of(samples: float, covariances: FloatArray) -> Interpolation:
        """Return the sample that comes a fraction of samples after the newest one."""
        among, to_it = np.split(covariances, 2)
        gram = toeplitz(among)
        values, vectors = np.linalg.eigh(gram)
        inverse = np.where(values > _INDEPENDENT * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
        weights = vectors @ (inverse * (vectors.T @ to_it))
        missed = among[0] - 2 * weights @ to_it + weights @ gram @ weights
        return Interpolation(int(samples) - POINTS + 1, weights, max(float(missed), 0.0))

    def variance(self, coefficients: FloatArray, sigma2: float, noise: float) -> float:
        """Least variance of its error, for ``F = sigma (1 + f_1 z^-1 + ...)`` of ``|F|^2 = Phi``.

        With the white noise R on the samples that are seen, the sum P, and ``F*`` the conjugate,
        the error of Wiener's filter is ``|[P F - R P / F*]_+|^2`` over powers above 0, and
        ``|P|^2 (R - R^2 / Phi)``. All but the finite sums over powers up to 0 cancels.
        """
        p, first = self.weights, self.first
        inverse = np.zeros(coefficients.size)  # of 1 / (1 + f_1 x + ...)
        inverse[0] = 1.0
        for n in range(1, inverse.size):
            inverse[n] = -coefficients[1 : n + 1] @ inverse[n - 1 :: -1][:n]
        powers = first + np.arange(p.size)
        forward = np.array([p[i:] @ coefficients[: p.size - i] for i in range(p.size)])
        backward = np.array([p[: i + 1] @ inverse[i::-1] for i in range(p.size)])
        past = powers <= 0
        error = sigma2 * np.sum(forward[~past] ** 2) - noise * np.sum(p**2)
        error += 2 * noise * np.sum(forward[past] * backward[past])
        return float(error - noise**2 / sigma2 * np.sum(backward[past] ** 2)) + self.missed


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Best prediction of a process whose spectrum has given integrals of its logarithm."""

    inner: InnerFactor
    mean_log: float  # mean of ``log(Phi / reference)``
    coefficients: FloatArray  # ``1, f_1, ...`` of ``F = sigma (1 + f_1 z^-1 + ...)``, (whole,)
    tails: FloatArray  # values of the later terms of F at the zeros of the all-pass factor

    @staticmethod
    def of(inner: InnerFactor, moments: FloatArray) -> Prediction:
        """Predict from the integrals of the logarithm times the weights of an inner factor."""
        f = _exponential(moments[: inner.terms])
        if inner.target is not None:
            return Prediction(inner, float(moments[0]), f, np.zeros(0))
        whole, tails = inner.whole, np.zeros(len(inner.zeros))
        for i, a in enumerate(inner.zeros):
            if a in inner.by_weight:
                value = float(np.exp(moments[inner.terms + inner.by_weight.index(a)]))
                tails[i] = (value - float(polyval(a, f[:whole]))) / a**whole
            else:
                tails[i] = float(polyval(a, f[whole:]))
        return Prediction(inner, float(moments[0]), f[:whole], tails)

    @property
    def _kernels(self) -> FloatArray:
        """Weights of the kernels ``1 / (1 - a z^-1)`` that the unreachable part is made of."""
        if not self.inner.zeros:
            return np.zeros(0)
        return np.asarray(np.linalg.solve(_gram(self.inner.zeros), self.tails))

    @property
    def later_power(self) -> float:
        """Sum of squares of all unreachable coefficients but the first, over sigma^2."""
        later = float(np.sum(self.coefficients[1:] ** 2))
        return later + max(float(self.tails @ self._kernels), 0.0)

    def variance(self, reference: float, noise: float) -> float:
        """Least variance of the residual; the reference is the noise unless that is zero."""
        sigma2 = np.exp(self.mean_log)
        if self.inner.target is not None:
            return self.inner.target.variance(self.coefficients, reference * sigma2, noise)
        if noise > 0:  # sums of positive numbers: no digits are lost however large the noise
            return float(reference * (np.expm1(self.mean_log) + sigma2 * self.later_power))
        return float(reference * sigma2 * (1 + self.later_power))

    def error_power(self, x: FloatArray) -> FloatArray:
        """``|P|^2 / sigma^2`` at frequencies x: the rejection is ``|P / F|^2``."""
        if self.inner.target is not None:
            raise ProblemError(
                "the limit over a band is known for whole frames of delay; got a fraction."
            )
        shift = np.exp(-1j * np.pi * x)
        part: ComplexArray = polyval(shift, self.coefficients)
        for a, weight in zip(self.inner.zeros, self._kernels, strict=True):
            part = part + weight * shift**self.inner.whole / (1 - a * shift)
        return np.asarray(np.abs(part) ** 2)


def _exponential(c: FloatArray) -> FloatArray:
    """As many coefficients of ``exp(c_1 x + c_2 x^2 + ...)`` as there are of c."""
    f = np.zeros(c.size)
    f[0] = 1.0
    weighted = np.arange(c.size) * c
    for n in range(1, c.size):
        f[n] = weighted[1 : n + 1] @ f[n - 1 :: -1][:n] / n
    return f
