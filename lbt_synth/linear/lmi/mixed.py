"""Minimise the variance of a filter under a bound on its norm, or the reverse.

With any stable predictor gain as a base, every stable filter is the base plus a stable
system Q driven by the base's innovations (D. C. Youla, H. A. Jabr, J. J. Bongiorno, IEEE
Trans. Autom. Control 21, 319 (1976), doi:10.1109/TAC.1976.1101223). The estimation error is
affine in Q, so variance and norm are convex in it. Here Q is a finite impulse response, and
the norm is bounded at given frequencies; the caller checks between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_triangular

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.lmi.solver import require_optimum, solve
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InnovationProgramme:
    """The convex programme of one base, for any bound and any set of frequencies.

    ``error(k) = L e(k) - sum_i c_i nu(k - 1 - i)``, with the base's estimation error e and
    innovations nu, scaled to unit variance.
    """

    error: StateSpace  # from w to ``L e``
    innovation: StateSpace  # from w to the scaled innovations
    whitening: FloatArray  # (q, q): scales the innovations
    # ``variance = floor + ||c root - target||^2``
    root: FloatArray  # (T q, T q): square root of the Gram matrix of the past innovations
    target: FloatArray  # (l, T q)
    floor: float  # least variance that these taps reach
    scale: float  # size of the error, by which levels are divided
    taps: int  # T

    @classmethod
    def from_predictor(
        cls, problem: EstimationProblem, gain_predictor: FloatArray, *, taps: int
    ) -> InnovationProgramme:
        """Set up the programme for a base with this predictor gain."""
        error = problem.error_system(gain_predictor)
        covariance = stationary_covariance(error.A, error.B @ error.B.T)
        whitening = np.linalg.inv(
            np.linalg.cholesky(problem.C @ covariance @ problem.C.T + problem.R)
        )
        C, D = whitening @ problem.C, whitening @ problem.D
        later = error.A @ covariance @ C.T + error.B @ D.T  # of e(k+1) with nu(k)
        lags, towards = [np.eye(len(C))], []
        for _ in range(taps):
            towards.append(problem.L @ later)
            lags.append(C @ later)
            later = error.A @ later
        gram = np.block(
            [[lags[j - i].T if j >= i else lags[i - j] for i in range(taps)] for j in range(taps)]
        )
        root = np.linalg.cholesky((gram + gram.T) / 2)
        target = solve_triangular(root, np.hstack(towards).T, lower=True).T
        total = float(np.trace(problem.L @ covariance @ problem.L.T))
        return cls(
            error=error,
            innovation=StateSpace(A=error.A, B=error.B, C=C, D=D, dt_s=problem.dt_s),
            whitening=np.asarray(whitening, dtype=np.float64),
            root=root,
            target=np.asarray(target, dtype=np.float64),
            floor=total - float(np.sum(target**2)),
            scale=float(np.sqrt(total)),
            taps=taps,
        )

    def minimize_variance(
        self, gamma: float, frequency_hz: FloatArray
    ) -> tuple[FloatArray, float, str]:
        """Minimise the variance with the error below gamma at the frequencies.

        Returns the taps (l, T q), gamma and the status of the solver.
        """
        taps = cp.Variable(self.target.shape)
        bounds = self._bounds(taps, gamma / self.scale, frequency_hz)
        run = solve(cp.Minimize(self._distance(taps)), bounds)
        return self._unscaled(taps, run), gamma, run[0]

    def minimize_level(
        self, variance: float, frequency_hz: FloatArray
    ) -> tuple[FloatArray, float, str]:
        """Minimise the level at the frequencies with a bound on the variance; likewise."""
        taps, level = cp.Variable(self.target.shape), cp.Variable(nonneg=True)
        slack = float(np.sqrt(max(variance - self.floor, 0.0))) / self.scale
        bounds = self._bounds(taps, level, frequency_hz)
        run = solve(cp.Minimize(level), [*bounds, self._distance(taps) <= slack])
        return self._unscaled(taps, run), float(level.value) * self.scale, run[0]

    def _distance(self, taps: cp.Variable) -> cp.Expression:
        return cp.norm(taps @ self.root - self.target / self.scale, "fro")

    def _unscaled(self, taps: cp.Variable, run: tuple[str, int]) -> FloatArray:
        require_optimum(
            run,
            "the programme of the mixed filter",
            "Try a larger bound, or another number of taps.",
        )
        unscaled = taps.value * self.scale @ np.kron(np.eye(self.taps), self.whitening)
        return np.asarray(unscaled, dtype=np.float64)

    def _bounds(
        self, taps: cp.Variable, level: float | cp.Variable, frequency_hz: FloatArray
    ) -> list[cp.Constraint]:
        """Constrain the spectral norm of the error below a level, frequency by frequency.

        With ``[N; E] = [[N1, 0], [E1, E2]] U`` and U orthonormal, ``E - Q N`` has the
        singular values of ``[E1 - Q N1, E2]``, of l rows and q + l columns.
        """
        outputs, q = len(self.target), self.innovation.C.shape[0]
        N, E = (s.frequency_response(frequency_hz) for s in (self.innovation, self.error))
        stacked = np.concatenate([N, E / self.scale], axis=1).conj().swapaxes(1, 2)
        triangle = np.asarray(np.linalg.qr(stacked, mode="r")).conj().swapaxes(1, 2)
        columns = triangle.shape[2]
        fixed, steered = triangle[:, q:, :], triangle[:, :q, :q]
        phase = np.exp(-2j * np.pi * frequency_hz * self.error.dt_s)
        constraints = []
        rows: list[cp.Expression] = []
        for i, z_inverse in enumerate(phase):
            powers = z_inverse ** np.arange(1, self.taps + 1)
            response = np.kron(powers[:, None], np.eye(q)) @ steered[i]  # (T q, q)
            shaped = np.zeros((self.taps * q, columns), dtype=np.complex128)
            shaped[:, :q] = response
            real = fixed[i].real - taps @ shaped.real
            imaginary = fixed[i].imag - taps @ shaped.imag
            if outputs == 1:
                rows.append(cp.hstack([real[0], imaginary[0]]))
                continue
            block = cp.bmat([[real, -imaginary], [imaginary, real]])
            constraints.append(_norm_below(block, level, 2 * outputs, 2 * columns))
        if rows:
            levels = cp.multiply(level, np.ones(len(rows)))
            constraints.append(cp.SOC(levels, cp.vstack(rows), axis=1))
        return constraints


def _norm_below(
    block: cp.Expression, level: float | cp.Variable, rows: int, columns: int
) -> cp.Constraint:
    """Constrain the spectral norm of a matrix below a level."""
    return cp.bmat([[level * np.eye(rows), block], [block.T, level * np.eye(columns)]]) >> 0
