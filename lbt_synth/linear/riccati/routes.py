"""The three routes to the stabilising solution of a Riccati equation.

A route takes a stack of equations and returns an approximate X and a count of steps for each;
X is not finite where the route failed. The caller refines and verifies it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy.linalg import solve_discrete_are

from lbt_synth.linear.matrix_functions import (
    component_labels,
    frobenius_norms,
    solve_stack,
    symmetrise,
    transpose,
)
from lbt_synth.linear.riccati.equations import Equations
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_WELL_CONDITIONED = 1e-8  # least ratio of R's eigenvalues at which R is inverted
_MOST_DOUBLINGS = 60
_ROUNDING = 4 * np.finfo(float).eps

Route: TypeAlias = Callable[[Equations], tuple[FloatArray, IntArray]]


def solve_by_doubling(equations: Equations) -> tuple[FloatArray, IntArray]:
    """Solve by structured doubling, which needs an R that can be inverted."""
    nothing = np.zeros_like(equations.Q)
    return _double_from(equations, nothing, _invertible(equations.R))


def solve_by_shifted_doubling(equations: Equations) -> tuple[FloatArray, IntArray]:
    """Solve by doubling for the excess over some steps of the Riccati recursion.

    With ``X = P + Y`` the equation of Y has the weight ``R + B'PB``, which can be
    inverted although R cannot, and for a positive semidefinite problem its constant
    term is the next step of the recursion less P, again positive semidefinite.
    """
    P = np.zeros_like(equations.Q)
    ready = np.zeros(len(P), dtype=bool)  # without a shift it is the first route
    for _ in range(equations.A.shape[-1] + 1):
        if np.all(ready):
            break
        weights = equations.weights(P)
        cross = transpose(equations.B) @ P @ equations.A + transpose(equations.S)
        inverse = np.linalg.pinv(
            np.where(np.isfinite(weights), weights, 0.0), rcond=1e-10, hermitian=True
        )
        step = symmetrise(
            equations.Q
            + transpose(equations.A) @ P @ equations.A
            - transpose(cross) @ inverse @ cross
        )
        P = np.where(ready[:, None, None], P, step)
        ready = ready | _invertible(equations.weights(P))
    return _double_from(equations, P, ready)


def solve_by_schur(equations: Equations) -> tuple[FloatArray, IntArray]:
    """Solve one by one by the ordered generalised Schur form of the extended pencil (scipy)."""
    X = np.full_like(equations.Q, np.nan)
    for i in range(len(X)):
        try:
            A, B, Q, R, S = (getattr(equations, name)[i] for name in "ABQRS")
            X[i] = symmetrise(solve_discrete_are(A, B, Q, R, s=S))
        except (np.linalg.LinAlgError, ValueError):
            continue
    return X, np.zeros(len(X), dtype=np.int64)


ROUTES: tuple[tuple[str, Route], ...] = (
    ("doubling", solve_by_doubling),
    ("shifted doubling", solve_by_shifted_doubling),
    ("schur", solve_by_schur),
)


def _invertible(R: FloatArray) -> BoolArray:
    """Whether each weight is well enough conditioned to be inverted, (N,)."""
    finite = np.asarray(np.all(np.isfinite(R), axis=(-2, -1)))
    size = np.abs(np.linalg.eigvalsh(np.where(finite[:, None, None], R, 0.0)))
    least, largest = size.min(axis=-1), size.max(axis=-1)
    return np.asarray(finite & (least > _WELL_CONDITIONED * largest), dtype=np.bool_)


def _double_from(
    equations: Equations, P: FloatArray, usable: BoolArray
) -> tuple[FloatArray, IntArray]:
    """Solve the usable equations for ``X - P`` by doubling; nan for the others."""
    X = np.full_like(equations.Q, np.nan)
    steps = np.zeros(len(X), dtype=np.int64)
    which = np.flatnonzero(usable)
    if which.size == 0:
        return X, steps
    part, P = equations.take(which), P[which]
    A, B = part.A, part.B
    PA = P @ A
    R, S = part.weights(P), part.S + transpose(PA) @ B
    Q = symmetrise(part.Q + transpose(A) @ PA - P)
    feedback = solve_stack(R, np.concatenate([transpose(S), transpose(B)], axis=-1))
    n = A.shape[-1]
    Y, steps[which] = doubling(
        A - B @ feedback[..., :n],
        symmetrise(B @ feedback[..., n:]),
        symmetrise(Q - S @ feedback[..., :n]),
    )
    X[which] = P + Y
    return X, steps


def doubling(A: FloatArray, G: FloatArray, H: FloatArray) -> tuple[FloatArray, IntArray]:
    """Iterate ``X = A' X (I + G X)^-1 A + H`` to its stabilising X, for arrays (N, n, n).

    E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77, 767 (2004),
    doi:10.1080/00207170410001714988. After j steps the iterate holds 2^j steps of the Riccati
    recursion; the convergence is quadratic. G need not be semidefinite. Return X, nan where the
    iteration did not converge, and the steps made (N,). An equation leaves the stack as soon as it
    has converged or diverged. The parts of one whose states do not act on one another are apart.
    """
    label = component_labels(np.any((A != 0) | (G != 0) | (H != 0), axis=0))
    found, steps = np.zeros_like(H), np.zeros(len(A), dtype=np.int64)
    for part in range(np.max(label, initial=-1) + 1):
        own = np.ix_(range(len(A)), label == part, label == part)
        found[own], made = _doubling_of_part(A[own], G[own], H[own])
        steps = np.maximum(steps, made)
    return found, steps


def _doubling_of_part(A: FloatArray, G: FloatArray, H: FloatArray) -> tuple[FloatArray, IntArray]:
    X, going, n = H, np.arange(len(A)), A.shape[-1]
    one = np.eye(n)
    found, steps = np.full_like(H, np.nan), np.zeros(len(A), dtype=np.int64)
    with np.errstate(all="ignore"):
        for step in range(1, _MOST_DOUBLINGS + 1):
            solved = solve_stack(one + G @ X, np.concatenate([A, G], axis=-1))
            WA, WG = solved[..., :n], solved[..., n:]
            increment = symmetrise(transpose(A) @ X @ WA)
            G = symmetrise(G + A @ WG @ transpose(A))
            X = X + increment
            A = A @ WA
            size = frobenius_norms(X)
            still = frobenius_norms(increment) <= _ROUNDING * size
            keep = ~still & np.isfinite(size)
            steps[going] = step
            if not keep.all():
                converged = still & np.isfinite(size)
                found[going[converged]] = X[converged]
                going, A, G, X = going[keep], A[keep], G[keep], X[keep]
                if going.size == 0:
                    break
    return found, steps
