"""Change to coordinates in which the semidefinite programmes are well conditioned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.estimation_problem import EstimationProblem, decorrelate, filter_gains
from lbt_synth.linear.infeasibility_proof import Witness, whitening_coordinates
from lbt_synth.validation import FloatArray, frozen_copy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LmiSolution:
    """A solved semidefinite programme, back in the problem's own coordinates."""

    gamma: float  # level of the programme (infinite for the Kalman filter)
    P: FloatArray  # (n, n): covariance, or ``gamma^2`` times the inverse of the storage matrix
    gain_predictor: FloatArray  # (n, q), in closed form from P
    gain_filter: FloatArray  # (n, q), in closed form from P
    status: str  # as reported by the solver; the design is certified without it
    iterations: int
    witness: Witness | None = None  # the dual solution of the least gamma


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BalancedProblem:
    """A problem in coordinates where a given error covariance is the identity."""

    problem: EstimationProblem  # decorrelated (``B D' = 0``), with unit measurement noise
    basis: FloatArray  # (n, r): ``x = basis xbar``; directions without error are dropped
    measurement_scale: FloatArray  # (q, q): ``ybar = measurement_scale y``
    output_scale: float  # ``zbar = z / output_scale``
    injection: FloatArray  # (n, q): part of the gain that the decorrelation adds

    def solution(
        self,
        P: FloatArray,
        information: FloatArray,
        run: tuple[str, int],
        *,
        gamma: float = np.inf,
        witness: Witness | None = None,
    ) -> LmiSolution:
        """Bring a covariance, and the gains of an information matrix, to the original states."""
        predictor, filtering = filter_gains(self.problem, information)
        back = self.basis @ predictor @ self.measurement_scale
        return LmiSolution(
            gamma=gamma,
            P=frozen_copy(self.basis @ P @ self.basis.T),
            gain_predictor=frozen_copy(back + self.injection),
            gain_filter=frozen_copy(self.basis @ filtering @ self.measurement_scale),
            status=run[0],
            iterations=run[1],
            witness=witness,
        )

    def witness(self, moments: FloatArray, basis: FloatArray) -> Witness:
        """Witness from a dual point: moments over a basis of balanced states and disturbances."""
        values, vectors = np.linalg.eigh((moments + moments.T) / 2)
        pairs = basis @ (vectors * np.sqrt(np.maximum(values, 0)))
        n = self.basis.shape[1]
        return Witness(states=self.basis @ pairs[:n], disturbances=pairs[n:])


def balance(
    problem: EstimationProblem, covariance: FloatArray, output_scale: float
) -> BalancedProblem:
    """Change to coordinates in which ``covariance``, (n, n), is the identity.

    The coordinates decide how accurate the solver is, not what it finds.
    """
    A_s, B_s, injection = decorrelate(problem)
    basis, inverse = whitening_coordinates(covariance)
    measurement_scale = np.linalg.inv(np.linalg.cholesky(problem.R))
    return BalancedProblem(
        problem=EstimationProblem(
            A=inverse @ A_s @ basis,
            B=inverse @ B_s,
            C=measurement_scale @ problem.C @ basis,
            D=measurement_scale @ problem.D,
            L=problem.L @ basis / output_scale,
        ),
        basis=frozen_copy(basis),
        measurement_scale=frozen_copy(measurement_scale),
        output_scale=output_scale,
        injection=injection,
    )
