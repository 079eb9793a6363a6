"""Poles of many loops of one mode that differ by sensor gain and delay, from those of a few.

Their characteristic polynomial is affine in the gain g and in ``g s``, where s is the fraction of
the later mirror: eigenvalues of a few loops give its coefficients. Newton's method then leads from
the poles of a loop to those of its neighbours. The zeros of a polynomial p of degree n lie within
discs about any distinct numbers z_i, of radius ``n |p(z_i)| / prod |z_i - z_j|`` (B. T. Smith,
J. ACM 17, 661 (1970), doi:10.1145/321607.321615), to which the errors of its coefficients add.
Loops whose discs are not small, or that are next to instability, get eigenvalues of their own.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import ComplexArray, FloatArray, IntArray

_SIDE = 12  # cells of neighbours in the gain, and in the fraction
_FEWEST = 8 * _SIDE**2  # loops that are worth it
_ORIGIN = 1e-3  # poles within are delays; their places matter to nobody
_STEPS = 5  # of Newton's method
_AT_ONCE = 1024  # loops, that they stay in the processor's cache
_DISC = 1e-8  # largest radius of a disc
_NEAR = 1e-5  # distance from the unit circle within which eigenvalues decide


def loop_poles(A: FloatArray, gain: FloatArray, fraction: FloatArray) -> ComplexArray:
    """Return the poles (k, s) of loops of one mode and one controller, of matrices (k, s, s)."""
    if len(A) < _FEWEST:
        return _eigenvalues(A)
    order, cell, middle = _cells(gain, fraction)
    known = _eigenvalues(A[middle])
    delays = np.sum(np.abs(known) < _ORIGIN, axis=1)
    degree = A.shape[-1] - int(delays[0])
    if np.any(delays != delays[0]) or not degree:
        return _eigenvalues(A)
    largest = np.argsort(-np.abs(known), axis=1)[:, :degree]
    known = np.take_along_axis(known, largest, axis=1) - 1  # where the slow ones crowd
    basis = np.stack([np.ones_like(gain), gain, gain * fraction], axis=1)
    coefficients = np.array([np.poly(each) for each in known]).real
    affine = np.linalg.lstsq(basis[middle], coefficients)[0]
    errors = np.max(np.abs(basis[middle] @ affine - coefficients), axis=0)
    poles = np.zeros(A.shape[:2], dtype=np.complex128)
    for start in range(0, len(A), _AT_ONCE):
        rows, near = order[start : start + _AT_ONCE], cell[start : start + _AT_ONCE]
        found, radius = _continue_zeros(basis[rows] @ affine, errors, known[near])
        apart = np.abs(np.max(np.abs(1 + found), axis=1) - 1) > _NEAR
        sure = apart & (radius < _DISC)
        poles[rows[sure], :degree] = 1 + found[sure]
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


def _continue_zeros(
    coefficients: FloatArray, errors: FloatArray, start: ComplexArray
) -> tuple[ComplexArray, FloatArray]:
    """Return zeros (k, n) of monic polynomials (k, n + 1), and the largest radius of their discs.

    Newton's method begins at given numbers (k, n). The coefficients have errors (n + 1,).
    """
    z, n = start, start.shape[1]
    with np.errstate(all="ignore"):  # what does not settle has no finite radius
        for _ in range(_STEPS):
            slope = _evaluate(coefficients[:, :-1] * np.arange(n, 0, -1), z)
            z = z - _evaluate(coefficients, z) / slope
        others = z[:, :, None] - z[:, None]
        others[:, range(n), range(n)] = 1
        size = (
            np.abs(_evaluate(coefficients, z))
            + _evaluate(errors[None], np.abs(z).astype(z.dtype)).real
        )
        radius = n * size / np.abs(np.prod(others, axis=2))
    return z, np.max(radius, axis=1)


def _evaluate(coefficients: FloatArray, z: ComplexArray) -> ComplexArray:
    """Return the values (k, n) of polynomials (k or 1, n), by Horner's scheme."""
    value = np.zeros_like(z) + coefficients[:, :1]
    for column in coefficients.T[1:, :, None]:
        value *= z
        value += column
    return value
