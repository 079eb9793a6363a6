"""Stationary covariances, by the discrete Lyapunov (Stein) equation."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from scipy.linalg import matrix_balance

from lbt_synth.errors import UnstableLoopError
from lbt_synth.linear.matrix_functions import (
    complex_schur,
    frobenius_norms,
    semidefinite_root,
    symmetrise,
    transpose,
)
from lbt_synth.validation import ComplexArray, FloatArray

# A step of refinement that moves X by more than this part of it is repeated with the residual in
# extended precision: next to the unit circle, rounding of the residual moves X by a million times
# itself and more.
_SETTLED = 1e-11

_Matrix = TypeVar("_Matrix", FloatArray, ComplexArray)


def stationary_covariance(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Solve ``X = A X A' + Q`` for an A (n, n) and a semidefinite Q, as a stack of one.

    An A whose spectral radius is not below 1 raises an UnstableLoopError.
    """
    X = stationary_covariances(A[None], Q[None])[0][0]
    if not np.isfinite(X).all():
        radius = float(np.max(np.abs(np.linalg.eigvals(A))))
        raise UnstableLoopError(
            "a stationary covariance needs a stable system; got a pole of modulus "
            f"{radius:.9g}, whose covariance grows without end.",
            spectral_radius=radius,
        )
    return np.asarray(X)


def stationary_covariances(A: FloatArray, Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve ``X = A X A' + Q`` for a stack (N, n, n); return X and its residuals (N,).

    By squaring with refinement; by roots (:func:`stationary_root`) where that does not settle, as
    with several poles next to each other and to the unit circle.
    """
    with np.errstate(all="ignore"):  # the caller judges the residuals
        X, step = smith_sum(A, Q), np.full(len(A), np.inf)
        poor = np.arange(len(A))
        precision: type[np.floating[Any]] = np.float64
        while poor.size:
            last = step[poor]
            X[poor], step[poor] = _refine(A[poor], Q[poor], X[poor], precision)
            poor = poor[(step[poor] > _SETTLED) & (step[poor] < last / 2)]
            precision = np.longdouble
        residuals = _relative_residuals(A, Q, X)
        for i in np.flatnonzero(~(step <= _SETTLED)):
            if np.max(np.abs(np.linalg.eigvals(A[i]))) < 1:
                root = stationary_root(A[i], semidefinite_root(Q[i]))
                X[i] = root @ root.T
                residuals[i] = _relative_residuals(A[i], Q[i], X[i])
    return X, residuals


def _relative_residuals(A: FloatArray, Q: FloatArray, X: FloatArray) -> FloatArray:
    """Return the residuals of ``X = A X A' + Q`` over the sizes of its terms."""
    AXA = A @ X @ transpose(A)
    size = frobenius_norms(X) + frobenius_norms(AXA) + frobenius_norms(Q)
    return np.asarray(frobenius_norms(AXA - X + Q) / np.where(size > 0, size, 1.0))


def _refine(
    A: FloatArray, Q: FloatArray, X: FloatArray, precision: type[np.floating[Any]]
) -> tuple[FloatArray, FloatArray]:
    """Correct X by its residual, summed in some precision; return the relative steps as well."""
    Ap, Xp = A.astype(precision), X.astype(precision)
    residual = (Ap @ Xp @ transpose(Ap) - Xp + Q).astype(np.float64)
    step = smith_sum(A, symmetrise(residual))
    return symmetrise(X + step), frobenius_norms(step) / np.maximum(frobenius_norms(X), 1e-300)


def smith_sum(A: _Matrix, Q: _Matrix) -> _Matrix:
    """Sum ``A^i Q A'^i`` over all i by squaring, for a stack of matrices, real or complex.

    R. A. Smith, SIAM J. Appl. Math. 16, 198 (1968), doi:10.1137/0116017. Not finite where A is
    not stable. Good for corrections only: it loses digits as A nears the unit circle.
    """
    X = Q
    with np.errstate(all="ignore"):
        for _ in range(60):
            X = X + A @ X @ transpose(A).conj()
            A = A @ A
            size = frobenius_norms(A)
            if not np.any(size > 1e-9):  # the rest is of the size of its square
                return np.where((size <= 1)[:, None, None], X, np.nan)
    return np.where((size <= 1e-9)[:, None, None], X, np.nan)


def stationary_root(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return R (n, r) with ``R R'`` the covariance of ``x+ = A x + B w``, for white w.

    By squaring, with sums of roots by QR: variances of outputs are sums of squares, with the error
    of their rms a share of the largest rms of a state, where a covariance has that of its square.
    The triangular form of A, in balanced units, keeps its eigenvalues in every power. Like any
    squaring, it loses digits as A nears the unit circle.
    """
    if not (A.size and B.size):
        return np.zeros((len(A), 0))
    balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
    triangle, basis = complex_schur(np.asarray(balanced, dtype=np.float64))
    root = (basis.conj().T / units) @ B
    with np.errstate(all="ignore"):
        for _ in range(60):
            root = join_roots(root, triangle @ root)
            triangle = triangle @ triangle
            if not np.linalg.norm(triangle) > 1e-16:
                break
    root = units[:, None] * (basis @ root)
    return np.asarray(join_roots(root.real, root.imag), dtype=np.float64)


def output_variances(C: FloatArray, D: FloatArray, root: FloatArray) -> FloatArray:
    """Return the variances of ``C x + D w``, sums of squares, for a root of the covariance of x."""
    return np.asarray(np.sum(np.hstack([C @ root, D]) ** 2, axis=1))


def join_roots(one: _Matrix, other: _Matrix) -> _Matrix:
    """Return R (n, r) with ``R R' = one one' + other other'``, real or complex."""
    factor: _Matrix = np.linalg.qr(np.hstack([one, other]).conj().T)[1]
    return factor.conj().T
