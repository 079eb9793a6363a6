"""A stack of Riccati equations: their units, gains, residuals and Newton steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.batched import norms, solve_stack, symmetrised, transposed
from lbt_synth.linear.lyapunov import smith_sum
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

# Where the platform has it, the residual is formed with 64 bits of mantissa instead of 53:
# the limit of accuracy is then the rounding of X itself, not that of the products.
_Extended = np.longdouble
_NEWTON_STEPS = 10
_SETTLED = 1e-13  # a Newton step this small is the last one
_SWEEPS = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refined:
    """Solutions after Newton steps: X and gains, relative residuals, estimated errors of X."""

    X: FloatArray
    gains: FloatArray
    residuals: FloatArray
    errors: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Equations:
    """Equations ``X = A'XA + Q - (A'XB + S)(R + B'XB)^-1 (B'XA + S')``, stacked."""

    # A, Q (N, n, n): state matrices and weights
    A: FloatArray
    # B, S (N, n, m): input matrices and cross weights
    B: FloatArray
    Q: FloatArray
    R: FloatArray  # (N, m, m): input weights, of any sign
    S: FloatArray

    def take(self, which: IntArray) -> Equations:
        """Return some of the equations."""
        return Equations(
            A=self.A[which], B=self.B[which], Q=self.Q[which], R=self.R[which], S=self.S[which]
        )

    def normalising_factors(self) -> FloatArray:
        """Powers of two by which Q, R and S can be divided so that they are of size one, (N,)."""
        sizes = [np.max(np.abs(part), axis=(-2, -1)) for part in (self.Q, self.R, self.S)]
        largest = np.max(np.stack(sizes), axis=0)
        exponents = np.round(np.log2(np.where(largest > 0, largest, 1.0)))
        return np.asarray(np.exp2(exponents), dtype=np.float64)

    def divided(self, factors: FloatArray) -> Equations:
        """Divide Q, R and S by a number each; X is then divided by it, too."""
        f = factors[:, None, None]
        return Equations(A=self.A, B=self.B, Q=self.Q / f, R=self.R / f, S=self.S / f)

    def in_units(self, units: FloatArray) -> Equations:
        """Change to states ``x_i / units_i``, (N, n); exact for powers of two."""
        column, row = units[:, None, :], units[:, :, None]
        return Equations(
            A=self.A * column / row,
            B=self.B / row,
            Q=self.Q * column * row,
            R=self.R,
            S=self.S * row,
        )

    def balancing_units(self) -> FloatArray:
        """Powers of two in which rows and columns of A, bordered by B and Q, are alike, (N, n)."""
        off = np.abs(self.A) * (1 - np.eye(self.A.shape[-1]))
        scale = np.maximum(np.abs(self.A).max(axis=(-2, -1)), 1e-300)[:, None]
        entry, weight = np.linalg.norm(self.B, axis=-1), np.sqrt(np.abs(_diagonal(self.Q)))
        entry = entry * scale / np.maximum(entry.max(axis=-1, keepdims=True), 1e-300)
        weight = weight * scale / np.maximum(weight.max(axis=-1, keepdims=True), 1e-300)
        exponent = np.zeros(entry.shape)
        for _ in range(_SWEEPS):
            units = np.exp2(exponent)
            rows = (off * units[:, None, :]).sum(axis=-1) / units + entry / units
            columns = (off / units[:, :, None]).sum(axis=-2) * units + weight * units
            both = (rows > 0) & (columns > 0)
            ratio = np.where(both, rows, 1.0) / np.where(both, columns, 1.0)
            exponent = exponent + 0.25 * np.log2(ratio)  # half a step: all states move at once
        units = np.exp2(np.round(exponent))
        usable = np.isfinite(units) & (units > 0)
        return np.where(usable.all(axis=-1, keepdims=True), units, 1.0)

    def weights(self, X: FloatArray) -> FloatArray:
        """``R + B'XB``, (N, m, m)."""
        return symmetrised(self.R + transposed(self.B) @ X @ self.B)

    def poles(self, gains: FloatArray) -> ComplexArray:
        """Poles of ``A - B gain``, (N, n); nan where the gain is not finite."""
        closed = self.A - self.B @ gains
        finite = np.isfinite(closed).all(axis=(-2, -1))
        poles = np.full(closed.shape[:-1], np.nan, dtype=np.complex128)
        poles[finite] = np.linalg.eigvals(closed[finite])
        return poles

    def evaluated(self, X: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gains ``(R + B'XB)^-1 (B'XA + S')``, residual matrices, and their relative sizes.

        The size is over those of X (1 + ||A - BK||^2), A'XA and Q. With K a gain near that of X,
        ``A'XA - X + Q - H'K - K'H + K'(R + B'XB)K`` with ``H = B'XA + S'`` differs from the
        residual by the square of the gain's error, and has no inverse in it, so that it can
        be summed in extended precision; the gain gets a step of iterative refinement first.
        """
        A, B, Q, R, S, Xe = (
            stack.astype(_Extended) for stack in (self.A, self.B, self.Q, self.R, self.S, X)
        )
        XA = Xe @ A
        AXA = transposed(A) @ XA
        H = transposed(B) @ XA + transposed(S)
        weight = R + transposed(B) @ Xe @ B
        rounded = symmetrised(weight.astype(np.float64))
        K = solve_stack(rounded, H.astype(np.float64)).astype(_Extended)
        K = K + solve_stack(rounded, (H - weight @ K).astype(np.float64))
        cross = transposed(H) @ K
        sums = AXA - Xe + Q - cross - transposed(cross) + transposed(K) @ weight @ K
        residual = symmetrised(sums.astype(np.float64))
        gains = K.astype(np.float64)
        # rounding X alone leaves a residual of eps ||X|| (1 + ||A - B K||^2)
        size = norms(X) * (1 + norms(self.A - self.B @ gains) ** 2)
        scale = size + norms(AXA.astype(np.float64)) + norms(self.Q)
        return gains, residual, norms(residual) / np.maximum(scale, 1e-300)

    def refined(self, X: FloatArray) -> Refined:
        """Newton steps while they lower the residual.

        An equation whose closed loop is not stable is left as it came. The next Newton
        step, that is not taken, estimates the error of X.
        """
        with np.errstate(all="ignore"):
            gains, residual, size = self.evaluated(X)
            X, error = X.copy(), np.full(len(X), np.inf)
            active = np.flatnonzero(np.isfinite(size))
            for _ in range(_NEWTON_STEPS):
                if active.size == 0:
                    break
                part = self.take(active)
                closed = transposed(part.A - part.B @ gains[active])
                step = smith_sum(closed, residual[active])
                trial = symmetrised(X[active] + step)
                new_gains, new_residual, new_size = part.evaluated(trial)
                better = np.isfinite(new_size) & (new_size < size[active])
                change = norms(step) / np.maximum(norms(trial), 1e-300)
                error[active] = np.where(np.isfinite(change), change, np.inf)
                done = active[better]
                X[done], gains[done] = trial[better], new_gains[better]
                residual[done], size[done] = new_residual[better], new_size[better]
                active = active[better & (change > _SETTLED)]
        return Refined(X=X, gains=gains, residuals=size, errors=error)


def _diagonal(stack: FloatArray) -> FloatArray:
    return np.asarray(np.diagonal(stack, axis1=-2, axis2=-1))
