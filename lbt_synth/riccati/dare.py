"""The discrete algebraic Riccati equation of control, with its evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import matrix_balance, solve_discrete_are

from lbt_synth.errors import DetectabilityError, NumericalError
from lbt_synth.lyapunov import stationary_covariance
from lbt_synth.riccati.doubling import doubling
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    definite,
    frozen,
    matrix,
    semidefinite,
    square,
)

RESIDUAL_LIMIT = 1e-9
_REFINEMENTS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DareSolution:
    """Stabilising solution of a discrete algebraic Riccati equation.

    Attributes
    ----------
    X : (n, n) ndarray
        The solution, symmetric.
    gain_feedback : (m, n) ndarray
        ``(R + B'XB)^-1 (B'XA + S')``; the closed loop is ``A - B gain_feedback``.
    poles : (n,) complex ndarray
        Poles of the closed loop.
    residual : float
        Relative residual of the equation in the 1-norm.
    method : str
        Route that gave X: "doubling" or "schur".
    iterations : int
        Doublings made (0 for "schur").
    """

    X: FloatArray
    gain_feedback: FloatArray
    poles: ComplexArray
    residual: float
    method: str
    iterations: int


def solve_dare(A: Any, B: Any, Q: Any, R: Any, S: Any = None) -> DareSolution:
    """Solve ``X = A'XA + Q - (A'XB + S)(R + B'XB)^-1 (B'XA + S')`` for its stabilising X.

    Structured doubling, then Newton refinement; scipy's Schur method if that
    fails. For the filter equation pass ``(A', C', B B', D D', B D')``.

    Parameters
    ----------
    A : (n, n) array_like
        State matrix.
    B : (n, m) array_like
        Input matrix.
    Q : (n, n) array_like
        State weight, symmetric; ``[[Q, S], [S', R]]`` positive semidefinite.
    R : (m, m) array_like
        Input weight, symmetric positive definite.
    S : (n, m) array_like, optional
        Cross weight.

    Returns
    -------
    DareSolution
        The solution, its gain, its poles and the residual that was measured.

    Raises
    ------
    DimensionError, NonFiniteError, DefinitenessError
        If the input is wrong.
    DetectabilityError
        If there is no stabilising solution; the message names the mode.
    NumericalError
        If no route reaches a relative residual of 1e-9 with a stable closed loop.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(float(lbt.solve_dare(1, 1, 1, 1).X[0, 0]), 12)        # (1 + sqrt 5) / 2
    1.61803398875
    """
    A = square(A, "A")
    n = A.shape[0]
    why = f"to match A {A.shape}"
    B = matrix(B, "B", rows=(n, why))
    m = B.shape[1]
    Q = semidefinite(Q, "Q", size=(n, why))
    R = definite(R, "R", size=(m, f"to match B {B.shape}"))
    if S is None:
        S = np.zeros((n, m))
    S = matrix(S, "S", rows=(n, why), cols=(m, f"to match B {B.shape}"))
    if np.any(S):
        semidefinite(np.block([[Q, S], [S.T, R]]), "[[Q, S], [S', R]]")

    shifted = A - B @ np.linalg.solve(R, S.T)
    weight = Q - S @ np.linalg.solve(R, S.T)
    _require_stabilising(A, B, shifted, (weight + weight.T) / 2)

    X, steps, converged = doubling(shifted, B @ np.linalg.solve(R, B.T), (weight + weight.T) / 2)
    solution = None
    if converged:
        solution = _refined(A, B, Q, R, S, X, "doubling", steps)
    if solution is None or solution.residual > RESIDUAL_LIMIT:
        solution = _schur(A, B, Q, R, S) or solution
    if solution is None or solution.residual > RESIDUAL_LIMIT:
        residual = None if solution is None else solution.residual
        raise NumericalError(
            "the Riccati equation was not solved: doubling and Schur both failed to reach a "
            f"relative residual of {RESIDUAL_LIMIT:g} with a stable closed loop; "
            f"got {residual}. Try to scale the states to similar sizes.",
            status="residual",
            residual=residual,
        )
    return solution


def unstable_hidden_mode(
    A: FloatArray, C: FloatArray, *, drive: FloatArray, only_unit_circle: bool = False
) -> complex | None:
    """Eigenvalue of A that does not decay and that C does not see, or None.

    The Popov-Belevitch-Hautus test on the eigenvalues with modulus 1 or more
    (or about 1, with ``only_unit_circle``). ``drive`` (n, p) enters the states: with
    it their units are chosen, on which the answer must not depend.
    """
    n = A.shape[0]
    border = np.block(
        [
            [np.abs(A), np.linalg.norm(drive, axis=1)[:, None]],
            [np.linalg.norm(C, axis=0)[None, :], np.zeros((1, 1))],
        ]
    )
    _, (scaling, _) = matrix_balance(border, permute=False, separate=True)
    units = np.asarray(scaling[:n], dtype=np.float64)
    A, C = A * units / units[:, None], C * units
    scale_A = max(float(np.linalg.norm(A, 2)), 1e-300)
    scale_C = max(float(np.linalg.norm(C, 2)), 1e-300)
    tol = 1e-10
    for value in np.linalg.eigvals(A):
        size = abs(value)
        if size < 1 - tol or (only_unit_circle and size > 1 + tol):
            continue
        pencil = np.vstack([(A - value * np.eye(n)) / scale_A, C / scale_C])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < tol:
            return complex(value)
    return None


def _require_stabilising(
    A: FloatArray, B: FloatArray, shifted: FloatArray, weight: FloatArray
) -> None:
    values, vectors = np.linalg.eigh(weight)
    root = (vectors * np.sqrt(np.maximum(values, 0))).T  # root' root = weight
    hidden = unstable_hidden_mode(A.T, B.T, drive=root.T)
    if hidden is not None:
        raise DetectabilityError(
            f"(A, B) must be stabilisable; the mode of A at {hidden:.6g} does not decay and B "
            "does not reach it. Give it an input, or take it out of the model.",
            eigenvalue=hidden,
        )
    hidden = unstable_hidden_mode(shifted, root, drive=B, only_unit_circle=True)
    if hidden is not None:
        raise DetectabilityError(
            f"Q must see every mode on the unit circle; the mode of A at {hidden:.6g} has no "
            "weight, so there is no stabilising solution. Add a small weight on it.",
            eigenvalue=hidden,
        )


def _residual(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray, X: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return the gain, the residual matrix and its relative size."""
    cross = B.T @ X @ A + S.T
    gain = np.asarray(np.linalg.solve(R + B.T @ X @ B, cross), dtype=np.float64)
    AXA = A.T @ X @ A
    residual = AXA - X + Q - cross.T @ gain
    scale = sum(float(np.linalg.norm(t, 1)) for t in (X, AXA, Q))
    return (
        gain,
        (residual + residual.T) / 2,
        float(np.linalg.norm(residual, 1)) / max(scale, 1e-300),
    )


def _refined(
    A: FloatArray,
    B: FloatArray,
    Q: FloatArray,
    R: FloatArray,
    S: FloatArray,
    X: FloatArray,
    method: str,
    iterations: int,
) -> DareSolution | None:
    """Newton steps while they lower the residual; None if the closed loop is not stable."""
    gain, residual, size = _residual(A, B, Q, R, S, X)
    for _ in range(_REFINEMENTS):
        closed = A - B @ gain
        if not np.max(np.abs(np.linalg.eigvals(closed))) < 1:
            return None
        refined = X + stationary_covariance(closed.T, residual)
        new_gain, new_residual, new_size = _residual(A, B, Q, R, S, refined)
        if not new_size < size:
            break
        X, gain, residual, size = refined, new_gain, new_residual, new_size
    poles = np.linalg.eigvals(A - B @ gain)
    return DareSolution(
        X=frozen(X),
        gain_feedback=frozen(gain),
        poles=poles.astype(np.complex128),
        residual=size,
        method=method,
        iterations=iterations,
    )


def _schur(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> DareSolution | None:
    try:
        X = solve_discrete_are(A, B, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return _refined(A, B, Q, R, S, (X + X.T) / 2, "schur", 0)
