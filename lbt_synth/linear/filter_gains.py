"""Turn the solution of a filter equation into gains, after decorrelating the noise."""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.validation import FloatArray, frozen_copy


def decorrelate(problem: EstimationProblem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``A_s = A - S R^-1 C``, ``B_s`` with ``B_s D' = 0``, and ``S R^-1``.

    Feeding the measurement into the state equation removes the correlation of process and
    measurement noise. A filter gain for (A_s, B_s) plus ``S R^-1`` is a gain for (A, B).
    """
    injection = np.linalg.solve(problem.R, problem.S.T).T
    return (
        frozen_copy(problem.A - injection @ problem.C),
        frozen_copy(problem.B - injection @ problem.D),
        frozen_copy(injection),
    )


def filter_gains(
    problem: EstimationProblem, information: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Predictor and filter gain of the information matrix ``M = Pt^-1``, which may be singular.

    ``gain_filter = (M + C'R^-1 C)^-1 C'R^-1`` stays finite.
    """
    A_s, _, injection = decorrelate(problem)
    weighted = np.linalg.solve(problem.R, problem.C).T  # C' R^-1
    gain_filter = np.linalg.solve(information + weighted @ problem.C, weighted)
    return frozen_copy(A_s @ gain_filter + injection), frozen_copy(gain_filter)
