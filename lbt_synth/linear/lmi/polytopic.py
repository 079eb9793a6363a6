"""Find one filter for a segment of plants, by parameter-dependent Lyapunov and slack matrices.

For the plants ``A = (1 - t) A_0 + t A_1`` with t in [0, 1], the filter ``xf+ = Af xf + Bf y``,
``zf = Cf xf`` and, in the coordinates (x, e) with ``e = x - xf``, slack matrices::

    G(t) = [[Z(t), 0], [U(t), K]],     Z and U affine in t, K of the filter

the error has a norm below gamma on the whole segment if for some P(t), quadratic in t,::

    [[G + G' - P,  G A_e,  G B_e,      0   ],
     [    .     ,    P  ,    0  ,    C_e'  ],
     [    .     ,    .  ,  g^2 I ,    0    ],   > 0      (M. C. de Oliveira, J. Bernussou,
     [    .     ,    .  ,    .   ,    I    ]]             J. C. Geromel)

which is linear in P, Z, U, K and the products ``K Af``, ``K Bf`` and Cf. Z and U multiply
nothing of the filter, so they may follow the parameter; K may not. The entries are
polynomials of degree two in t, and their three Bernstein coefficients must be positive
definite. For the variance the third row and column become an inequality of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.infeasibility_proof import whitening_coordinates
from lbt_synth.linear.lmi.conic_data import require_optimum
from lbt_synth.linear.lmi.solver import solve, symmetrise
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.validation import FloatArray, frozen_copy

_RANK = 1e-11  # share of its trace added to a covariance, so that no direction is lost


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentFilter:
    """A filter ``xf+ = A xf + B y``, ``zf = C xf`` for a segment of plants, as solved.

    Its order is that of the plant, less the states that are sums of others.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    bound: float  # norm, or standard deviation, that the programme claims for the whole segment
    status: str  # as reported by the solver, which is no evidence
    iterations: int


def segment_filter(
    problem: EstimationProblem,
    ends: tuple[FloatArray, FloatArray],
    *,
    norm: str,
    coordinates: FloatArray,
    scale: float,
) -> SegmentFilter:
    """Filter of the least bound over a segment of plants, given the state matrices at its ends."""
    programme = _Programme(problem, ends, coordinates, scale)
    level = cp.Variable(nonneg=True)
    constraints = [
        inequality >> 0 for k in range(3) for inequality in programme.inequalities(k, norm, level)
    ]
    run = solve(cp.Minimize(level), constraints)
    require_optimum(run, "the semidefinite programme of the interval", "Try a narrower interval.")
    try:
        inverse = np.linalg.inv(programme.K.value)
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            "the slack matrix of the filter is singular. Try a narrower interval.", status=run[0]
        ) from error
    back = programme.basis @ inverse
    return SegmentFilter(
        A=frozen_copy(back @ programme.KA.value @ programme.inverse),
        B=frozen_copy(-back @ programme.KB.value @ programme.measurement_scale),
        C=frozen_copy(programme.output.value @ programme.inverse * scale),
        bound=float(np.sqrt(level.value)) * scale,
        status=run[0],
        iterations=run[1],
    )


class _Programme:
    """The segment in independent states of size one, and the variables of the programme.

    The errors of these states are ``basis`` times errors of size one; states that never move are
    dropped.
    """

    def __init__(
        self,
        problem: EstimationProblem,
        ends: tuple[FloatArray, FloatArray],
        coordinates: FloatArray,
        scale: float,
    ) -> None:
        states = stationary_covariance((ends[0] + ends[1]) / 2, problem.Q)
        wide, narrow = whitening_coordinates(states)
        errors = narrow @ coordinates @ narrow.T
        self.basis, self.inverse = whitening_coordinates(
            errors + _RANK * np.trace(errors) * np.eye(len(errors))
        )
        self.measurement_scale = np.linalg.inv(np.linalg.cholesky(problem.R))
        self.ends = [narrow @ end @ wide for end in ends]
        self.B, self.L = narrow @ problem.B, problem.L @ wide / scale
        self.C = self.measurement_scale @ problem.C @ wide
        self.D = self.measurement_scale @ problem.D
        n, (outputs, q) = len(self.basis), (len(self.L), len(self.C))
        self.Z, self.U = ([cp.Variable((n, n)) for _ in range(2)] for _ in range(2))
        self.K, self.KA = cp.Variable((n, n)), cp.Variable((n, n))
        self.KB = cp.Variable((n, q))  # of -Bf
        self.output = cp.Variable((outputs, n))

    def inequalities(self, k: int, norm: str, level: Any) -> list[Any]:
        """Bernstein coefficients of index k, the matrices that must be positive."""
        n, p, outputs = len(self.basis), self.B.shape[1], len(self.L)
        Z, U = _coefficient(self.Z, k), _coefficient(self.U, k)
        zero = np.zeros((n, n))
        own = U + self.K @ self.inverse  # of what drives the states
        G = cp.bmat([[Z, zero], [U, self.K]])
        after = _product(self.U, self.ends, k) + self.K @ self.inverse @ _coefficient(self.ends, k)
        GA = cp.bmat(
            [
                [_product(self.Z, self.ends, k), zero],
                [after + self.KB @ self.C - self.KA @ self.inverse, self.KA],
            ]
        )
        GB = cp.vstack([Z @ self.B, own @ self.B + self.KB @ self.D])
        C = cp.hstack([self.L - self.output @ self.inverse, self.output])
        P = cp.Variable((2 * n, 2 * n), symmetric=True)
        slack, none = G + G.T - P, np.zeros((2 * n, outputs))
        if norm == "h2":
            W = cp.Variable((p, p), symmetric=True)
            decay = [[slack, GA, none], [GA.T, P, C.T], [none.T, C, np.eye(outputs)]]
            entry = [[slack, GB], [GB.T, W]]
            return [
                symmetrise(cp.bmat(decay)),
                symmetrise(cp.bmat(entry)),
                cp.reshape(level - cp.trace(W), (1, 1), order="C"),
            ]
        across = np.zeros((2 * n, p))
        whole = [
            [slack, GA, GB, none],
            [GA.T, P, across, C.T],
            [GB.T, across.T, level * np.eye(p), np.zeros((p, outputs))],
            [none.T, C, np.zeros((outputs, p)), np.eye(outputs)],
        ]
        return [symmetrise(cp.bmat(whole))]


def _coefficient(ends: Any, k: int) -> Any:
    """Bernstein coefficient k, of degree two, of an affine function with these ends."""
    return (1 - k / 2) * ends[0] + (k / 2) * ends[1]


def _product(left: Any, right: Any, k: int) -> Any:
    """Bernstein coefficient k of the product of two affine functions."""
    if k == 1:
        return (left[0] @ right[1] + left[1] @ right[0]) / 2
    return left[k // 2] @ right[k // 2]
