"""Coordinates in which the semidefinite programmes are well conditioned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.filter_gains import decorrelated, filter_gains
from lbt_synth.linear.infeasibility_proof import Witness, identity_coordinates
from lbt_synth.validation import FloatArray, frozen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BalancedProblem:
    """A problem in coordinates where a given error covariance is the identity."""

    # Decorrelated (``B D' = 0``), of unit measurement noise and scaled z
    problem: EstimationProblem
    basis: FloatArray  # (n, r): ``x = basis xbar``; directions without error are dropped
    sensor_scale: FloatArray  # (q, q): ``ybar = sensor_scale y``
    output_scale: float  # ``zbar = z / output_scale``
    injection: FloatArray  # (n, q): what the decorrelation added to the gain

    def gains(self, information: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predictor and filter gain, in the original coordinates, of an information matrix."""
        predictor, filtering = filter_gains(self.problem, information)
        back = self.basis @ predictor @ self.sensor_scale
        return frozen(back + self.injection), frozen(self.basis @ filtering @ self.sensor_scale)

    def witness(self, moments: FloatArray, basis: FloatArray) -> Witness:
        """Witness of a dual point: moments over a basis of balanced states and disturbances."""
        values, vectors = np.linalg.eigh((moments + moments.T) / 2)
        pairs = basis @ (vectors * np.sqrt(np.maximum(values, 0)))
        n = self.basis.shape[1]
        return Witness(states=frozen(self.basis @ pairs[:n]), disturbances=frozen(pairs[n:]))

    def covariance(self, balanced: FloatArray) -> FloatArray:
        """Covariance in the original coordinates."""
        return frozen(self.basis @ balanced @ self.basis.T)


def balanced(
    problem: EstimationProblem, covariance: FloatArray, output_scale: float
) -> BalancedProblem:
    """Change to coordinates in which ``covariance`` is the identity.

    The coordinates decide how well the solver sees, not what it finds. Shapes: covariance (n, n).
    """
    A_s, B_s, injection = decorrelated(problem)
    basis, inverse = identity_coordinates(covariance)
    sensor_scale = np.linalg.inv(np.linalg.cholesky(problem.R))
    return BalancedProblem(
        problem=EstimationProblem(
            A=inverse @ A_s @ basis,
            B=inverse @ B_s,
            C=sensor_scale @ problem.C @ basis,
            D=sensor_scale @ problem.D,
            L=problem.L @ basis / output_scale,
        ),
        basis=frozen(basis),
        sensor_scale=frozen(sensor_scale),
        output_scale=output_scale,
        injection=injection,
    )
