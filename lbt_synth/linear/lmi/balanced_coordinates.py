"""Change to coordinates in which the semidefinite programmes are well conditioned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.filter_gains import decorrelate, filter_gains
from lbt_synth.linear.infeasibility_proof import Witness, whitening_coordinates
from lbt_synth.validation import FloatArray, frozen_copy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BalancedProblem:
    """A problem in coordinates where a given error covariance is the identity."""

    problem: EstimationProblem  # decorrelated (``B D' = 0``), with unit measurement noise
    basis: FloatArray  # (n, r): ``x = basis xbar``; directions without error are dropped
    measurement_scale: FloatArray  # (q, q): ``ybar = measurement_scale y``
    output_scale: float  # ``zbar = z / output_scale``
    injection: FloatArray  # (n, q): part of the gain that the decorrelation adds

    def gains(self, information: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predictor and filter gain of an information matrix, in the original coordinates."""
        predictor, filtering = filter_gains(self.problem, information)
        back = self.basis @ predictor @ self.measurement_scale
        return frozen_copy(back + self.injection), frozen_copy(
            self.basis @ filtering @ self.measurement_scale
        )

    def witness(self, moments: FloatArray, basis: FloatArray) -> Witness:
        """Witness from a dual point: moments over a basis of balanced states and disturbances."""
        values, vectors = np.linalg.eigh((moments + moments.T) / 2)
        pairs = basis @ (vectors * np.sqrt(np.maximum(values, 0)))
        n = self.basis.shape[1]
        return Witness(
            states=frozen_copy(self.basis @ pairs[:n]), disturbances=frozen_copy(pairs[n:])
        )

    def covariance(self, balanced: FloatArray) -> FloatArray:
        """Covariance in the original coordinates."""
        return frozen_copy(self.basis @ balanced @ self.basis.T)


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
