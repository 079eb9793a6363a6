"""The Kalman filter: least variance of the estimation error."""

from __future__ import annotations

import numpy as np

from lbt_synth.design.filter_design import FilterDesign, filter_design
from lbt_synth.design.result import SolverReport
from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.validation import FloatArray, choice, require_instance


def kalman(problem: EstimationProblem, *, route: str = "riccati") -> FilterDesign:
    """Design the steady-state Kalman filter of an estimation problem.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; a plant gives a controller. The estimate is one frame ahead of the newest
        measurement; ``problem.ahead`` is the problem of another one.
    route : {"riccati", "sdp"}, optional
        The Riccati equation, or a semidefinite programme, which takes from the Riccati
        solution only the coordinates and the scale of its variables.

    Returns
    -------
    FilterDesign
        Certified design; ``rms`` is the least standard deviation.

    Raises
    ------
    DetectabilityError
        If no stable filter exists; the message names the mode.
    NumericalError
        If the solver fails.
    CertificateError
        If the design does not pass its checks.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> walk = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> design = lbt.kalman(walk)
    >>> round(float(design.gain_predictor[0, 0]), 9), design.certificate.passed
    (0.618033989, True)
    """
    require_instance(problem, EstimationProblem)
    choice(route, "route", ("riccati", "sdp"))
    solution = kalman_riccati(problem)
    if route == "sdp":
        problem.require_one_phase("the semidefinite programme", "route='riccati'")
        from lbt_synth.linear.lmi.filters import kalman_sdp

        scale = error_scale(problem, solution.P)
        solution = kalman_sdp(problem, coordinates=solution.P, scale=scale)
    return filter_design(
        problem,
        solution.gain_predictor,
        method="kalman",
        solver=SolverReport(route=route, status=solution.status),
    )


def error_scale(problem: EstimationProblem, P: FloatArray) -> float:
    """Return the standard deviation of the error in its worst direction, or 1 if it is zero."""
    worst = float(np.max(np.linalg.eigvalsh(problem.L @ P @ problem.L.T)[..., -1]))
    return float(np.sqrt(worst)) if worst > 0 else 1.0
