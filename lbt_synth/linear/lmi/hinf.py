"""Solve for the H-infinity predictor by a linear matrix inequality.

The gain is eliminated: with N a basis of the null space of ``[C D]``, a filter
with error norm below gamma exists if and only if some P satisfies::

    Nx'P Nx + gamma^2 Nw'Nw - (A Nx + B Nw)' P (A Nx + B Nw) - (L Nx)'(L Nx) > 0
    P - L'L > 0

P is the storage matrix of the error system; ``gamma^2 P^-1`` takes the place of
the Riccati solution, and the gain follows from it in closed form. Elimination:
P. Gahinet, P. Apkarian, Int. J. Robust Nonlinear Control 4, 421 (1994),
doi:10.1002/rnc.4590040403.
"""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space

from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.linear.lmi.balanced_coordinates import BalancedProblem, balance
from lbt_synth.linear.lmi.solver import USABLE, LmiSolution, solve, symmetrise
from lbt_synth.validation import FloatArray


def least_gamma_lmi(
    problem: EstimationProblem, *, coordinates: FloatArray, scale: float
) -> LmiSolution:
    """Find the least gamma, and a filter that reaches it."""
    scaled = balance(problem, coordinates, scale)
    P = cp.Variable(scaled.problem.A.shape, symmetric=True)
    gamma_squared = cp.Variable(nonneg=True)
    basis = null_space(np.hstack([scaled.problem.C, scaled.problem.D]))
    inequalities = _inequalities(scaled.problem, basis, P, gamma_squared, 1.0)
    status, iterations = solve(cp.Minimize(gamma_squared), inequalities)
    if status not in USABLE or P.value is None or gamma_squared.value is None:
        raise NumericalError(
            f"the least gamma's semidefinite programme ended as {status!r}; expected an optimum. "
            'Try route="riccati".',
            status=status,
        )
    level = float(gamma_squared.value)
    witness = scaled.witness(inequalities[0].dual_value, basis)
    return _unpack(scaled, P.value / level, level, status, iterations, witness)


def hinf_lmi(
    problem: EstimationProblem, gamma: float, *, coordinates: FloatArray, scale: float
) -> LmiSolution:
    """Find the central filter of a given gamma, which has the greatest storage matrix."""
    scaled = balance(problem, coordinates, scale)
    level = (gamma / scale) ** 2
    P = cp.Variable(scaled.problem.A.shape, symmetric=True)
    basis = null_space(np.hstack([scaled.problem.C, scaled.problem.D]))
    inequalities = _inequalities(scaled.problem, basis, P, 1.0, 1 / level)
    status, iterations = solve(cp.Maximize(cp.trace(P)), inequalities)
    if "infeasible" in status:
        raise InfeasibleError(
            f"no H-infinity filter reaches gamma = {gamma:.9g}: the LMI is infeasible. "
            "Try a larger gamma.",
            gamma=gamma,
        )
    if status not in USABLE or P.value is None:
        raise NumericalError(
            f"the semidefinite programme of the H-infinity filter ended as {status!r}; expected "
            'an optimum. Try route="riccati".',
            status=status,
        )
    return _unpack(scaled, P.value, level, status, iterations)


def _inequalities(
    problem: EstimationProblem, basis: FloatArray, P: Any, input_weight: Any, output_weight: float
) -> list[Any]:
    """Return the two inequalities; dividing them by gamma^2 suits a large, given level."""
    A, B, L = problem.A, problem.B, problem.L
    n = A.shape[0]
    Nx, Nw = basis[:n], basis[n:]
    step, seen = A @ Nx + B @ Nw, L @ Nx
    dissipation = (
        Nx.T @ P @ Nx
        + input_weight * (Nw.T @ Nw)
        - step.T @ P @ step
        - output_weight * (seen.T @ seen)
    )
    return [symmetrise(dissipation) >> 0, P - output_weight * (L.T @ L) >> 0]


def _unpack(
    scaled: BalancedProblem,
    P: FloatArray,
    gamma_squared: float,
    status: str,
    iterations: int,
    witness: Witness | None = None,
) -> LmiSolution:
    """Turn ``P / gamma^2`` into gains and a covariance in the problem's coordinates."""
    storage = (P + P.T) / 2
    information = storage - scaled.problem.L.T @ scaled.problem.L / gamma_squared
    predictor, filtering = scaled.gains(information)
    return LmiSolution(
        gamma=float(np.sqrt(gamma_squared) * scaled.output_scale),
        P=scaled.covariance(np.asarray(np.linalg.inv(storage), dtype=np.float64)),
        gain_predictor=predictor,
        gain_filter=filtering,
        status=status,
        iterations=iterations,
        witness=witness,
    )
