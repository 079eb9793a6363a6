"""Solve the Riccati equation of the Kalman predictor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import DetectabilityError
from lbt_synth.linear.estimation_problem import EstimationProblem, decorrelate
from lbt_synth.linear.riccati.dare import solve_dare
from lbt_synth.linear.riccati.solvability import unstable_hidden_mode
from lbt_synth.validation import FloatArray, frozen_copy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterRiccati:
    """A solved filter equation.

    Attributes
    ----------
    P : (n, n) ndarray
        Covariance of the prediction error (Kalman), or its H-infinity counterpart.
    gain_predictor, gain_filter : (n, q) ndarray
        Gains of the measurement and the time update together, and of the measurement update
        alone.
    residual : float
        Relative residual of the equation.
    iterations : int
        Number of doublings.
    status : str
        The route that gave P.
    """

    P: FloatArray
    gain_predictor: FloatArray
    gain_filter: FloatArray
    residual: float
    iterations: int
    status: str


def require_detectable(problem: EstimationProblem) -> None:
    """Raise if no stable filter exists."""
    hidden = unstable_hidden_mode(problem.A, problem.C, drive=problem.B)
    if hidden is not None:
        raise DetectabilityError(
            f"(A, C) must be detectable; the mode of A at {hidden:.6g} does not decay and no "
            "measurement sees it. Measure it, or take it out of the model.",
            eigenvalue=hidden,
        )
    A_s, B_s, _ = decorrelate(problem)
    hidden = unstable_hidden_mode(A_s.T, B_s.T, drive=problem.C.T, only_unit_circle=True)
    if hidden is not None:
        raise DetectabilityError(
            f"every mode on the unit circle must be driven by noise; the mode of A at "
            f"{hidden:.6g} is not, so the filter would stop correcting it. Add a column to B.",
            eigenvalue=hidden,
        )


def kalman_riccati(problem: EstimationProblem) -> FilterRiccati:
    """Solve ``P = A P A' + Q - (A P C' + S)(R + C P C')^-1 (C P A' + S')``.

    ``lbt_synth.design.kalman`` returns the same filter as a certified design.

    Parameters
    ----------
    problem : EstimationProblem
        The problem.

    Returns
    -------
    FilterRiccati
        The stabilising solution and its gains.

    Raises
    ------
    DetectabilityError
        If there is no stabilising solution.
    NumericalError
        If the equation was not solved.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> round(float(lbt.linear.kalman_riccati(p).P[0, 0]), 12)
    1.61803398875
    """
    require_detectable(problem)
    dare = solve_dare(problem.A.T, problem.C.T, problem.Q, problem.R, problem.S)
    innovation = problem.R + problem.C @ dare.X @ problem.C.T
    gain_filter = np.linalg.solve(innovation, problem.C @ dare.X).T
    return FilterRiccati(
        P=dare.X,
        gain_predictor=frozen_copy(dare.gain_feedback.T),
        gain_filter=frozen_copy(gain_filter),
        residual=dare.residual,
        iterations=dare.iterations,
        status=dare.route,
    )
