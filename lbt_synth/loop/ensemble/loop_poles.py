"""Poles of many loops of one mode that differ by sensor gain and delay, from those of a few.

With a gain g and a fraction s of the later mirror, the characteristic polynomial of a loop is::

    p(z) = d(z) + g ((1 - s) n0(z) + s n1(z))

A product of factors evaluates each of the three accurately, even where poles crowd. Weierstrass'
iteration ``z_i - w_i``, with ``w_i = p(z_i) / prod (z_i - z_j)``, leads from the poles of a loop to
those of its neighbours. All zeros of p lie in discs of radius ``n |w_i|`` about any distinct
numbers z_i (B. T. Smith, J. ACM 17, 661 (1970), doi:10.1145/321607.321615). What the polynomials
miss at eigenvalues of some loops adds to these radii. Loops whose discs are not small, or that are
next to instability, get eigenvalues of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.linalg import eigvals

from lbt_synth.linear import StateSpace
from lbt_synth.linear.state_space import pointwise_response
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

Parts: TypeAlias = tuple[FloatArray, FloatArray]

_SIDE = 12  # cells of neighbours in the gain, and in the fraction
_FEWEST = 8 * _SIDE**2  # loops that are worth it
_ORIGIN = 1e-3  # poles and zeros within are delays; their places matter to nobody
_INFINITE = 1e8  # zeros beyond are none
_STEPS = 5  # of the iteration
_AT_ONCE = 8192  # poles, that they stay in the processor's cache
_DISC = 1e-8  # largest radius of a disc
_NEAR = 1e-5  # distance from the unit circle within which eigenvalues decide
_PROBE = 1.5 * np.exp(1j)  # where zeros get their factor


def loop_poles(
    A: FloatArray, gain: FloatArray, fraction: FloatArray, ends: Sequence[Parts]
) -> ComplexArray:
    """Return the poles (k, s) of loops of one mode and one controller, of matrices (k, s, s).

    The loops at fractions of 0 and 1 have matrices ``A0 + g A1``, the ends, (s, s) each.
    """
    if len(A) < _FEWEST:
        return _eigenvalues(A)
    order, cell, middle = _cells(gain, fraction)
    extremes = [place(x) for x in (gain, fraction) for place in (np.argmin, np.argmax)]
    seen = np.append(middle, extremes)  # where the polynomials are checked
    known, family = _eigenvalues(A[seen]), _Family.of(ends)
    if family is None:
        return _eigenvalues(A)
    degree = A.shape[-1] - family.delays
    known = np.where(np.abs(known) < _ORIGIN, 0, known)
    near = np.take_along_axis(known, np.argsort(-np.abs(known), axis=1)[:, :degree], axis=1)
    missed = family.miss(near, gain[seen], fraction[seen])
    _, radius = family.find_zeros(near, gain[seen], fraction[seen], missed)
    if not np.median(radius) < _DISC:
        return _eigenvalues(A)
    poles, step = np.zeros(A.shape[:2], dtype=np.complex128), max(1, _AT_ONCE // degree)
    for start in range(0, len(A), step):
        rows, begin = order[start : start + step], near[cell[start : start + step]]
        found, radius = family.find_zeros(begin, gain[rows], fraction[rows], missed)
        far = np.abs(np.max(np.abs(found), axis=1) - 1) > _NEAR
        sure = far & (radius < _DISC)
        found.imag[np.abs(found.imag) < _DISC] = 0  # its conjugate is in the same disc
        poles[rows[sure], :degree] = found[sure]
        poles[rows[~sure]] = _eigenvalues(A[rows[~sure]])
    return poles


def _eigenvalues(A: FloatArray) -> ComplexArray:
    return np.linalg.eigvals(A).astype(np.complex128)


def _cells(gain: FloatArray, fraction: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return an order of loops by cells of neighbours, their cells, and the middle loop of each."""
    count = gain.size
    strip = np.empty(count, dtype=np.int64)
    strip[np.argsort(gain, kind="stable")] = np.arange(count) * _SIDE // count
    order = np.lexsort((fraction, strip))
    edges = np.arange(_SIDE**2 + 1) * count // _SIDE**2
    cell = np.repeat(np.arange(_SIDE**2), np.diff(edges))
    return order, cell, order[(edges[:-1] + edges[1:]) // 2]


@dataclass(frozen=True, slots=True, eq=False)
class _Family:
    """The characteristic polynomials of loops, but for the poles of delays, by their zeros."""

    delays: int  # zeros at the origin that all have
    d: ComplexArray  # (n,)
    n: tuple[ComplexArray, ComplexArray]  # (m,) each
    factors: tuple[complex, complex]

    @classmethod
    def of(cls, ends: Sequence[Parts]) -> _Family | None:
        """Return the family of loops between two ends; None if a controller does nothing."""
        poles, zeros, factors = _eigenvalues(ends[0][0]), [], []
        for A0, A1 in ends:
            left, sizes, right = np.linalg.svd(A1)  # of rank one
            if sizes[0] == 0:
                return None
            entry, leaving = left[:, :1] * sizes[0], right[:1]
            found = _zeros(A0, entry, leaving)
            system = StateSpace(A=A0, B=entry, C=leaving, D=np.zeros((1, 1)))
            response = pointwise_response(system, np.array([_PROBE]))[0, 0, 0]
            zeros.append(found)
            factors.append(-response * np.prod(_PROBE - poles) / np.prod(_PROBE - found))
        snapped = [np.where(np.abs(each) < _ORIGIN, 0, each) for each in (poles, *zeros)]
        delays = min(int(np.sum(each == 0)) for each in snapped)
        d, *n = (each[np.argsort(np.abs(each))[delays:]] for each in snapped)
        return cls(delays, d, (n[0], n[1]), (factors[0], factors[1]))

    def evaluate(
        self, z: ComplexArray, gain: FloatArray, fraction: FloatArray
    ) -> tuple[ComplexArray, FloatArray, ComplexArray]:
        """Return values at numbers (k, n), the sizes of their terms, and ``prod |z_i - z_j|``."""
        g, s = gain[:, None], fraction[:, None]
        terms = [_product(z, self.d)]
        for zeros, factor, share in zip(self.n, self.factors, (1 - s, s), strict=True):
            terms.append(g * share * factor * _product(z, zeros))
        value, size = sum(terms, np.zeros_like(z)), np.sum(np.abs(terms), axis=0)
        apart = np.ones_like(z)
        for j in range(z.shape[1]):
            other = z - z[:, j, None]
            other[:, j] = 1
            apart *= other
        return value, np.asarray(size), apart

    def miss(self, zeros: ComplexArray, gain: FloatArray, fraction: FloatArray) -> float:
        """Return what the values at known zeros (k, n) are of the sizes of their terms, at most.

        Those at the origin are not known: they count as such from near it on.
        """
        with np.errstate(all="ignore"):  # infinite where a term overflows
            value, size, _ = self.evaluate(zeros, gain, fraction)
            part = np.abs(value) / np.maximum(size, np.finfo(float).tiny)
        return float(np.max(np.nan_to_num(part, nan=np.inf), where=zeros != 0, initial=0.0))

    def find_zeros(
        self, start: ComplexArray, gain: FloatArray, fraction: FloatArray, missed: float
    ) -> tuple[ComplexArray, FloatArray]:
        """Return zeros (k, n) from given numbers, and the largest radius of their discs (k,).

        The values miss a part of the sizes of their terms.
        """
        z = start
        with np.errstate(all="ignore"):  # what does not settle has no finite radius
            for _ in range(_STEPS):
                value, _, apart = self.evaluate(z, gain, fraction)
                z = z - value / apart
            value, size, apart = self.evaluate(z, gain, fraction)
            radius = z.shape[1] * (np.abs(value) + missed * size) / np.abs(apart)
        return z, np.max(radius, axis=1)


def _zeros(A: FloatArray, entry: FloatArray, leaving: FloatArray) -> ComplexArray:
    """Return the finite zeros of ``leaving (z - A)^-1 entry``."""
    n = len(A)
    pencil = np.block([[A, entry], [leaving, np.zeros((1, 1))]])
    with np.errstate(all="ignore"):
        found = eigvals(pencil, np.diag([1.0] * n + [0.0]))
    return np.asarray(found[np.abs(found) < _INFINITE], dtype=np.complex128)


def _product(z: ComplexArray, zeros: ComplexArray) -> ComplexArray:
    """Return the product of all ``z - zero``, as z."""
    out = np.ones_like(z)
    for zero in zeros.tolist():
        out *= z - zero
    return out
