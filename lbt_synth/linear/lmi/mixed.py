"""Minimise the variance of a filter under a bound on its norm.

With any stable predictor gain as a base, every stable filter is the base plus a stable
system Q driven by the base's innovations (D. C. Youla, H. A. Jabr, J. J. Bongiorno, IEEE
Trans. Autom. Control 21, 319 (1976), doi:10.1109/TAC.1976.1101223). The estimation error is
affine in Q, so variance and norm are convex in it. Here Q is a finite impulse response, and
the norm is bounded at given frequencies; the caller checks between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_triangular

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.lmi.conic_program import require_optimum
from lbt_synth.linear.lmi.programmes import norm_below, solve
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.matrix_functions import component_labels
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import ComplexArray, FloatArray

_APART = 1e-11  # cosine of two responses below which they have nothing in common


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InnovationProgramme:
    """The convex programme of one base, for any bound and any set of frequencies.

    ``error(k) = L e(k) - sum_i c_i nu(k - 1 - i)``, with the base's estimation error e and
    innovations nu, scaled to unit variance.
    """

    error: StateSpace  # from w to ``L e``
    innovation: StateSpace  # from w to the scaled innovations
    whitening: FloatArray  # (q, q): scales the innovations
    # the variance is ``||c root - target||^2`` and a constant
    root: FloatArray  # (T q, T q): square root of the Gram matrix of the past innovations
    target: FloatArray  # (l, T q)
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
            scale=float(np.sqrt(total)),
            taps=taps,
        )

    def minimize_variance(self, gamma: float, frequency_hz: FloatArray) -> tuple[FloatArray, str]:
        """Minimise the variance with the error below gamma at the frequencies.

        Returns the taps (l, T q) and the status of the solver.
        """
        N, E = (s.frequency_response(frequency_hz) for s in (self.innovation, self.error))
        outputs, q = len(self.target), N.shape[1]
        taps: Any = 0  # (l, T q), zero between groups
        constraints: list[Any] = []
        phase = np.exp(-2j * np.pi * frequency_hz * self.error.dt_s)
        powers = phase[:, None] ** np.arange(1, self.taps + 1)
        for rows, columns in _independent_groups(N, E):
            Q = cp.Variable((len(rows), self.taps * len(columns)))
            past = np.kron(np.eye(self.taps), np.eye(q)[columns])
            taps = taps + np.eye(outputs)[:, rows] @ Q @ past
            responses = N[:, columns], E[:, rows] / self.scale
            constraints += _bound_norm(*responses, powers, Q, gamma / self.scale)
        spread = cp.norm(taps @ self.root - self.target / self.scale, "fro")
        run = solve(cp.Minimize(spread), constraints)
        advice = "Try a larger bound, or another number of taps."
        require_optimum(run, "the programme of the mixed filter", advice)
        unscaled = self.scale * taps.value @ np.kron(np.eye(self.taps), self.whitening)
        return np.asarray(unscaled, dtype=np.float64), run[0]


def _independent_groups(N: ComplexArray, E: ComplexArray) -> list[tuple[list[int], list[int]]]:
    """Group outputs and innovations that share a disturbance: no tap between groups is of use."""
    stacked = np.concatenate([N, E], axis=1)
    size = np.linalg.norm(stacked, axis=(0, 2))
    products = np.abs(stacked @ stacked.conj().swapaxes(1, 2)).sum(axis=0)
    labels = component_labels(products > _APART * size[:, None] * size)
    q = N.shape[1]
    groups = []
    for label in np.unique(labels[q:]):
        rows, columns = np.nonzero(labels[q:] == label)[0], np.nonzero(labels[:q] == label)[0]
        groups.append((rows.tolist(), columns.tolist()))
    return groups


def _bound_norm(
    N: ComplexArray, E: ComplexArray, powers: ComplexArray, Q: Any, level: Any
) -> list[Any]:
    """Keep the spectral norm of ``E - Q N`` below a level at F frequencies, of T powers of 1/z.

    With ``[N; E] = [[N1, 0], [E1, E2]] U`` and U orthonormal, ``E - Q N`` has the singular
    values of ``[E1 - Q N1, E2]``, of l rows and at most q + l columns.
    """
    count, q, _ = N.shape
    stacked = np.concatenate([N, E], axis=1).conj().swapaxes(1, 2)
    triangle = np.asarray(np.linalg.qr(stacked, mode="r")).conj().swapaxes(1, 2)
    # (T q, F, columns) of the innovations, each tap delayed by its frames
    steered = np.einsum("ft,fqc->tqfc", powers, triangle[:, :q]).reshape(Q.shape[1], count, -1)
    fixed = triangle[:, q:]
    if fixed.shape[1] == 1:
        past = steered.reshape(len(steered), -1)
        parts = [
            cp.reshape(now - Q @ before, (count, now.size // count), order="C")
            for now, before in (
                (fixed.real.reshape(1, -1), past.real),
                (fixed.imag.reshape(1, -1), past.imag),
            )
        ]
        return [cp.norm(cp.hstack(parts), 2, axis=1) <= level]
    return [
        norm_below(now.real - Q @ before.real, now.imag - Q @ before.imag, level)
        for now, before in zip(fixed, steered.swapaxes(0, 1), strict=True)
    ]
