"""Many Riccati equations as arrays: scaling, two routes to X, residuals and Newton steps.

X is not finite where a route failed. The caller refines and verifies it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from lbt_synth.linear.lyapunov import smith_sum
from lbt_synth.linear.matrix_functions import (
    component_labels,
    frobenius_norms,
    nearest_powers_of_two,
    solve_stack,
    symmetrise,
    transpose,
)
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

# Where the platform has it, the residual is formed with 64 bits of mantissa instead of 53:
# the limit of accuracy is then the rounding of X itself, not that of the products.
_Extended = np.longdouble
_SETTLED = 1e-13  # a Newton step this small is the last one
_BALANCING_STEPS = 6
_WELL_CONDITIONED = 1e-8  # least ratio of R's eigenvalues at which R is inverted
_MOST_DOUBLINGS = 60
_ROUNDING = 4 * np.finfo(float).eps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solutions:
    """Refined answers to N equations."""

    X: FloatArray
    gains: FloatArray
    poles: ComplexArray
    residuals: FloatArray  # relative
    errors: FloatArray  # of X, estimated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Equations:
    """Equations ``X = A'XA + Q - (A'XB + S)(R + B'XB)^-1 (B'XA + S')``, stacked."""

    A: FloatArray  # (N, n, n)
    B: FloatArray  # (N, n, m)
    Q: FloatArray  # (N, n, n)
    R: FloatArray  # (N, m, m), of any sign
    S: FloatArray  # (N, n, m)

    def take(self, which: IntArray) -> Equations:
        """Return some of the equations."""
        return Equations(**{name: getattr(self, name)[which] for name in "ABQRS"})

    def scaled(self) -> tuple[Equations, FloatArray, FloatArray]:
        """Divide the weights by factors (N,), the states by units (N, n), all powers of two.

        The largest of Q, R and S is then of size one, and X is divided by the same factor.
        """
        sizes = [np.max(np.abs(part), axis=(-2, -1)) for part in (self.Q, self.R, self.S)]
        largest = np.max(sizes, axis=0)
        factors = nearest_powers_of_two(largest)
        f, units = factors[:, None, None], self._balancing_units()
        column, row = units[:, None, :], units[:, :, None]
        scaled = Equations(
            A=self.A * column / row,
            B=self.B / row,
            Q=self.Q / f * column * row,
            R=self.R / f,
            S=self.S / f * row,
        )
        return scaled, factors, units

    def _balancing_units(self) -> FloatArray:
        """Powers of two that make rows and columns of A, bordered by B and Q, alike, (N, n)."""
        off = np.abs(self.A) * (1 - np.eye(self.A.shape[-1]))
        scale = np.maximum(np.abs(self.A).max(axis=(-2, -1)), 1e-300)[:, None]
        entry = np.linalg.norm(self.B, axis=-1)
        weight = np.sqrt(np.abs(np.diagonal(self.Q, axis1=-2, axis2=-1)))
        entry = entry * scale / np.maximum(entry.max(axis=-1, keepdims=True), 1e-300)
        weight = weight * scale / np.maximum(weight.max(axis=-1, keepdims=True), 1e-300)
        exponent = np.zeros(entry.shape)
        for _ in range(_BALANCING_STEPS):
            units = np.exp2(exponent)
            rows = (off * units[:, None, :]).sum(axis=-1) / units + entry / units
            columns = (off / units[:, :, None]).sum(axis=-2) * units + weight * units
            both = (rows > 0) & (columns > 0)
            ratio = np.where(both, rows, 1.0) / np.where(both, columns, 1.0)
            exponent = exponent + 0.25 * np.log2(ratio)  # half a step, as all states move at once
        units = np.exp2(np.round(exponent))
        usable = np.isfinite(units) & (units > 0)
        return np.where(usable.all(axis=-1, keepdims=True), units, 1.0)

    def weights(self, X: FloatArray) -> FloatArray:
        """``R + B'XB``, (N, m, m)."""
        return symmetrise(self.R + transpose(self.B) @ X @ self.B)

    def poles(self, gains: FloatArray) -> ComplexArray:
        """Poles of ``A - B gain``, (N, n); nan where the gain is not finite."""
        closed = self.A - self.B @ gains
        finite = np.isfinite(closed).all(axis=(-2, -1))
        poles = np.full(closed.shape[:-1], np.nan, dtype=np.complex128)
        poles[finite] = np.linalg.eigvals(closed[finite])
        return poles

    def evaluate(self, X: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gains ``(R + B'XB)^-1 (B'XA + S')``, residual matrices, and their relative sizes.

        The residual is relative to the sizes of X (1 + ||A - BK||^2), A'XA and Q. If K is near
        the gain of X,
        ``A'XA - X + Q - H'K - K'H + K'(R + B'XB)K`` with ``H = B'XA + S'`` differs from the
        residual by the square of the gain's error, and has no inverse in it, so that it can
        be summed in extended precision; the gain gets a step of iterative refinement first.
        """
        A, B, Q, R, S, Xe = (
            stack.astype(_Extended) for stack in (self.A, self.B, self.Q, self.R, self.S, X)
        )
        XA = Xe @ A
        AXA = transpose(A) @ XA
        H = transpose(B) @ XA + transpose(S)
        weight = R + transpose(B) @ Xe @ B
        rounded = symmetrise(weight.astype(np.float64))
        K = solve_stack(rounded, H.astype(np.float64)).astype(_Extended)
        K = K + solve_stack(rounded, (H - weight @ K).astype(np.float64))
        cross = transpose(H) @ K
        sums = AXA - Xe + Q - cross - transpose(cross) + transpose(K) @ weight @ K
        residual = symmetrise(sums.astype(np.float64))
        gains = K.astype(np.float64)
        # rounding X alone leaves a residual of eps ||X|| (1 + ||A - B K||^2)
        size = frobenius_norms(X) * (1 + frobenius_norms(self.A - self.B @ gains) ** 2)
        scale = size + frobenius_norms(AXA.astype(np.float64)) + frobenius_norms(self.Q)
        return gains, residual, frobenius_norms(residual) / np.maximum(scale, 1e-300)

    def contractions(self, X: FloatArray, gains: FloatArray) -> FloatArray:
        """Second Newton step over the first, for the residual that rounding of the data leaves.

        Where it is small, Newton's method converges from X, so a stabilising solution exists. A
        pole that rounding alone has moved off the unit circle gives one or more, as its distance is
        the square root of what moved it.
        """
        sizes = (
            self._magnitudes(X, np.eye(X.shape[-1]))
            + self._magnitudes(X, self.A)
            + self._magnitudes(self.Q, np.eye(X.shape[-1]))
            + self._magnitudes(self.weights(X), gains)
        )
        rounding = X.shape[-1] * np.finfo(float).eps * sizes[..., None] * np.eye(X.shape[-1])
        closed = self.A - self.B @ gains
        first = smith_sum(transpose(closed), rounding)
        moved = transpose(self.B) @ first @ closed
        change = symmetrise(transpose(moved) @ solve_stack(self.weights(X), moved))
        second = smith_sum(transpose(closed), change)
        return np.asarray(frobenius_norms(second) / np.maximum(frobenius_norms(first), 1e-300))

    @staticmethod
    def _magnitudes(weight: FloatArray, M: FloatArray) -> FloatArray:
        """Bound of the diagonal of ``M' weight M``, without cancellation."""
        root = np.sqrt(np.abs(np.diagonal(weight, axis1=-2, axis2=-1)))
        return np.asarray((np.abs(transpose(M)) @ root[..., None])[..., 0] ** 2)

    def refine(self, X: FloatArray) -> Solutions:
        """Take Newton steps while they lower the residual.

        An equation whose closed loop is not stable is left alone. The next Newton step,
        which is not taken, estimates the error of X.
        """
        with np.errstate(all="ignore"):
            gains, residual, size = self.evaluate(X)
            X, error = X.copy(), np.full(len(X), np.inf)
            active = np.flatnonzero(np.isfinite(size))
            while active.size:
                part = self.take(active)
                closed = transpose(part.A - part.B @ gains[active])
                step = smith_sum(closed, residual[active])
                trial = symmetrise(X[active] + step)
                new_gains, new_residual, new_size = part.evaluate(trial)
                better = np.isfinite(new_size) & (new_size < size[active])
                change = frobenius_norms(step) / np.maximum(frobenius_norms(trial), 1e-300)
                error[active] = np.where(np.isfinite(change), change, np.inf)
                done = active[better]
                X[done], gains[done] = trial[better], new_gains[better]
                residual[done], size[done] = new_residual[better], new_size[better]
                active = active[better & (change > _SETTLED)]
            poles = self.poles(gains)
        return Solutions(X=X, gains=gains, poles=poles, residuals=size, errors=error)


def solve_by_doubling(equations: Equations) -> tuple[FloatArray, int]:
    """Solve by structured doubling, which must invert R; return the most steps made as well.

    Where R cannot be inverted, the doubling is for the excess over some steps P of the Riccati
    recursion: with ``X = P + Y`` the equation of Y has the weight ``R + B'PB``, and for a positive
    semidefinite problem its constant term is the next step of the recursion less P, again positive
    semidefinite.
    """
    P = np.zeros_like(equations.Q)
    ready = _invertible(equations.R)
    for _ in range(equations.A.shape[-1]):
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
    X, which = np.full_like(equations.Q, np.nan), np.flatnonzero(ready)
    usable, P = equations.take(which), P[which]
    A, B, PA = usable.A, usable.B, P @ usable.A
    R, S = usable.weights(P), usable.S + transpose(PA) @ B
    Q = symmetrise(usable.Q + transpose(A) @ PA - P)
    feedback = solve_stack(R, np.concatenate([transpose(S), transpose(B)], axis=-1))
    n = A.shape[-1]
    Y, steps = doubling(
        A - B @ feedback[..., :n],
        symmetrise(B @ feedback[..., n:]),
        symmetrise(Q - S @ feedback[..., :n]),
    )
    X[which] = P + Y
    return X, steps


def solve_by_schur(equations: Equations) -> FloatArray:
    """Solve one by one by the ordered generalised Schur form of the extended pencil (scipy)."""
    X = np.full_like(equations.Q, np.nan)
    for i in range(len(X)):
        try:
            A, B, Q, R, S = (getattr(equations, name)[i] for name in "ABQRS")
            X[i] = symmetrise(solve_discrete_are(A, B, Q, R, s=S))
        except (np.linalg.LinAlgError, ValueError):
            continue
    return X


def _invertible(R: FloatArray) -> BoolArray:
    """Whether each weight is well enough conditioned to be inverted, (N,)."""
    finite = np.asarray(np.all(np.isfinite(R), axis=(-2, -1)))
    size = np.abs(np.linalg.eigvalsh(np.where(finite[:, None, None], R, 0.0)))
    least, largest = size.min(axis=-1), size.max(axis=-1)
    return np.asarray(finite & (least > _WELL_CONDITIONED * largest), dtype=np.bool_)


def doubling(A: FloatArray, G: FloatArray, H: FloatArray) -> tuple[FloatArray, int]:
    """Iterate ``X = A' X (I + G X)^-1 A + H`` to its stabilising X, for arrays (N, n, n).

    E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77, 767 (2004),
    doi:10.1080/00207170410001714988. After j steps the iterate holds 2^j steps of the Riccati
    recursion; the convergence is quadratic. G need not be semidefinite. Return X, nan where the
    iteration did not converge, and the most steps made. States that do not act on one another,
    such as those of two axes, are iterated apart: blocks of one size as one stack.
    """
    label = component_labels(np.any((A != 0) | (G != 0) | (H != 0), axis=0))
    solutions, steps, sizes = np.zeros_like(H), 0, np.bincount(label)
    for n in np.unique(sizes):
        states = np.array([np.flatnonzero(label == one) for one in np.flatnonzero(sizes == n)])
        blocks = np.s_[:, states[:, :, None], states[:, None, :]]  # (N, blocks, n, n)
        X, made = _doubling_of_blocks(*(one[blocks].reshape(-1, n, n) for one in (A, G, H)))
        solutions[blocks], steps = X.reshape(len(A), len(states), n, n), max(steps, made)
    return solutions, steps


def _doubling_of_blocks(A: FloatArray, G: FloatArray, H: FloatArray) -> tuple[FloatArray, int]:
    """Double equations until each has converged or diverged, when it leaves the stack."""
    X, going, n, step = H, np.arange(len(A)), A.shape[-1], 0
    one, solutions = np.eye(n), np.full_like(H, np.nan)
    with np.errstate(all="ignore"):
        while going.size and step < _MOST_DOUBLINGS:
            step += 1
            solved = solve_stack(one + G @ X, np.concatenate([A, G], axis=-1))
            WA, WG = solved[..., :n], solved[..., n:]
            increment = symmetrise(transpose(A) @ X @ WA)
            G = symmetrise(G + A @ WG @ transpose(A))
            X = X + increment
            A = A @ WA
            size = frobenius_norms(X)
            still = frobenius_norms(increment) <= _ROUNDING * size
            converged, keep = still & np.isfinite(size), ~still & np.isfinite(size)
            solutions[going[converged]] = X[converged]
            going, A, G, X = going[keep], A[keep], G[keep], X[keep]
    return solutions, step
