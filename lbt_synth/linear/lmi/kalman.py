"""Solve for the Kalman filter by a semidefinite programme."""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.lmi.balanced_coordinates import balance
from lbt_synth.linear.lmi.solver import USABLE, LmiSolution, solve, symmetrise
from lbt_synth.validation import FloatArray


def kalman_sdp(problem: EstimationProblem, *, coordinates: FloatArray, scale: float) -> LmiSolution:
    """Maximise tr P subject to ``[[APA' + Q - P, APC'], [CPA', R + CPC']] >= 0``.

    The stabilising solution of the filter Riccati equation is the greatest P that satisfies the
    inequality (S. Boyd et al., "Linear Matrix Inequalities in System and Control Theory", SIAM
    (1994), doi:10.1137/1.9781611970777).
    """
    scaled = balance(problem, coordinates, scale)
    A, B, C = scaled.problem.A, scaled.problem.B, scaled.problem.C
    n, q = A.shape[0], C.shape[0]
    P = cp.Variable((n, n), symmetric=True)
    block = cp.bmat(
        [[A @ P @ A.T + B @ B.T - P, A @ P @ C.T], [C @ P @ A.T, np.eye(q) + C @ P @ C.T]]
    )
    status, iterations = solve(cp.Maximize(cp.trace(P)), [symmetrise(block) >> 0, P >> 0])
    if status not in USABLE or P.value is None:
        raise NumericalError(
            f"the semidefinite programme of the Kalman filter ended as {status!r}; expected "
            'an optimum. Try route="riccati".',
            status=status,
        )
    information = np.linalg.inv((P.value + P.value.T) / 2)
    predictor, filtering = scaled.gains(information)
    return LmiSolution(
        gamma=np.inf,
        P=scaled.covariance(P.value),
        gain_predictor=predictor,
        gain_filter=filtering,
        status=status,
        iterations=iterations,
    )
