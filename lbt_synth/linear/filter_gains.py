"""Algebra that every route to a filter gain shares."""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.validation import FloatArray, frozen


def decorrelated(problem: EstimationProblem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``A_s = A - S R^-1 C``, ``B_s`` with ``B_s D' = 0``, and ``S R^-1``.

    Feeding the measurement into the state equation takes out the correlation of
    process and measurement noise; a filter gain for (A_s, B_s) plus ``S R^-1``
    is one for (A, B).
    """
    injection = np.linalg.solve(problem.R, problem.S.T).T
    return (
        frozen(problem.A - injection @ problem.C),
        frozen(problem.B - injection @ problem.D),
        frozen(injection),
    )


def filter_gains(
    problem: EstimationProblem, information: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Predictor and filter gain of the information matrix ``M = Pt^-1`` (or zero directions).

    ``gain_filter = (M + C'R^-1 C)^-1 C'R^-1``, which stays finite where M is singular.
    """
    A_s, _, injection = decorrelated(problem)
    weighted = np.linalg.solve(problem.R, problem.C).T  # C' R^-1
    gain_filter = np.linalg.solve(information + weighted @ problem.C, weighted)
    return frozen(A_s @ gain_filter + injection), frozen(gain_filter)
