"""Solve for the H-infinity predictor by semidefinite programmes.

The gain is eliminated: with N a basis of the null space of
``[C D]``, a filter with error norm below gamma exists if and only if some P satisfies::

    Nx'P Nx + gamma^2 Nw'Nw - (A Nx + B Nw)' P (A Nx + B Nw) - (L Nx)'(L Nx) > 0
    P - L'L > 0

P is the storage matrix of the error system; ``gamma^2 P^-1`` takes the place of
the Riccati solution, and the gain follows from it in closed form. Elimination:
P. Gahinet, P. Apkarian, Int. J. Robust Nonlinear Control 4, 421 (1994),
doi:10.1002/rnc.4590040403.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space

from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem, decorrelate, filter_gains
from lbt_synth.linear.infeasibility_proof import Witness, whitening_coordinates
from lbt_synth.linear.lmi.conic_program import require_optimum
from lbt_synth.linear.lmi.programmes import solve, symmetric_variable, symmetrise
from lbt_synth.linear.matrix_functions import part_labels, semidefinite_root
from lbt_synth.linear.riccati.filtering import FilterRiccati
from lbt_synth.validation import FloatArray, IntArray, frozen_copy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BalancedProblem:
    """A problem in coordinates where a given error covariance is the identity."""

    problem: EstimationProblem  # decorrelated (``B D' = 0``), with unit measurement noise
    basis: FloatArray  # (n, r): ``x = basis xbar``; directions without error are dropped
    measurement_scale: FloatArray  # (q, q): ``ybar = measurement_scale y``
    injection: FloatArray  # (n, q): part of the gain that the decorrelation adds

    def solution(
        self, P: FloatArray, information: FloatArray, run: tuple[str, int]
    ) -> FilterRiccati:
        """Bring a covariance, and the gains of an information matrix, to the original states."""
        try:
            predictor, filtering = filter_gains(self.problem, information)
        except np.linalg.LinAlgError as error:
            raise NumericalError(
                f"the inequality's storage matrix has no gain: {error}. {_ADVICE}", status=run[0]
            ) from error
        back = self.basis @ predictor @ self.measurement_scale
        return FilterRiccati(
            P=frozen_copy(self.basis @ P @ self.basis.T),
            gain_predictor=frozen_copy(back + self.injection),
            gain_filter=frozen_copy(self.basis @ filtering @ self.measurement_scale),
            residual=np.nan,
            status=run[0],
            iterations=run[1],
        )

    def witness(self, moments: FloatArray, basis: FloatArray) -> Witness:
        """Witness from a dual point: moments over a basis of balanced states and disturbances."""
        pairs = basis @ semidefinite_root(moments)
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
        injection=injection,
    )


_ADVICE = 'Try route="riccati".'


def least_gamma_lmi(
    problem: EstimationProblem, *, coordinates: FloatArray, scale: float
) -> tuple[FilterRiccati, Witness]:
    """Find the least gamma, and a filter that reaches it; the dual solution is its witness."""
    scaled = balance(problem, coordinates, scale)
    basis, parts = _invisible_basis(scaled.problem)
    P, level = symmetric_variable(_parts(scaled.problem)[0]), cp.Variable(nonneg=True)
    dissipation, storage = _storage_inequalities(scaled.problem, basis, P, level, 1.0)
    run = solve(cp.Minimize(level), [dissipation, storage])
    require_optimum(run, "the least gamma's semidefinite programme", _ADVICE)
    moments = np.where(parts[:, None] == parts, dissipation.dual_value, 0.0)
    solution = _unpack(scaled, P.value / level.value, float(level.value), run)
    return solution, scaled.witness(moments, basis)


def hinf_lmi(
    problem: EstimationProblem, gamma: float, *, coordinates: FloatArray, scale: float
) -> FilterRiccati:
    """Find the central filter of a given gamma, which has the greatest storage matrix.

    All is divided by ``gamma^2``, which suits large levels.
    """
    scaled = balance(problem, coordinates, scale)
    level = (gamma / scale) ** 2
    P = symmetric_variable(_parts(scaled.problem)[0])
    basis, _ = _invisible_basis(scaled.problem)
    inequalities = _storage_inequalities(scaled.problem, basis, P, 1.0, 1 / level)
    run = solve(cp.Maximize(cp.trace(P)), inequalities)
    if "infeasible" in run[0]:
        raise InfeasibleError(
            f"no H-infinity filter reaches gamma = {gamma:.9g}: the LMI is infeasible. "
            "Try a larger gamma.",
            gamma=gamma,
        )
    require_optimum(run, "the semidefinite programme of the H-infinity filter", _ADVICE)
    return _unpack(scaled, P.value, level, run)


def _storage_inequalities(
    problem: EstimationProblem, basis: FloatArray, P: Any, level: Any, weight: float
) -> list[Any]:
    """Return both inequalities of the module, with ``level`` for gamma^2 and a weight of L'L."""
    A, B, L = problem.A, problem.B, problem.L
    Nx, Nw = basis[: len(A)], basis[len(A) :]
    step, seen = A @ Nx + B @ Nw, L @ Nx
    supplied = Nx.T @ P @ Nx + level * (Nw.T @ Nw)
    dissipation = supplied - step.T @ P @ step - weight * (seen.T @ seen)
    return [symmetrise(dissipation) >> 0, P - weight * (L.T @ L) >> 0]


def _parts(problem: EstimationProblem) -> tuple[IntArray, IntArray]:
    """Return the numbers of the parts of the states and of the disturbances.

    The blocks of a solution that belong to the parts are a solution as well: they are the mean of
    ``S P S`` over all signs S of the parts, under which the problem stays the same.
    """
    outputs = np.vstack([problem.C, problem.L])
    direct = np.vstack([problem.D, np.zeros((len(problem.L), problem.D.shape[1]))])
    return part_labels(problem.A, problem.B, outputs, direct)[:2]


def _invisible_basis(problem: EstimationProblem) -> tuple[FloatArray, IntArray]:
    """Return a basis (n + w, d) of the null space of ``[C D]``, and the part of each vector."""
    label, seen = np.concatenate(_parts(problem)), np.hstack([problem.C, problem.D])
    basis = np.zeros((len(label), 0))
    parts: IntArray = np.zeros(0, dtype=np.int64)
    for part in np.unique(label):
        rows = label == part
        vectors = np.eye(len(label))[:, rows] @ null_space(seen[:, rows])
        basis = np.hstack([basis, vectors])
        parts = np.append(parts, np.full(vectors.shape[1], part))
    return basis, parts


def _unpack(
    scaled: BalancedProblem, P: FloatArray, level: float, run: tuple[str, int]
) -> FilterRiccati:
    """Turn ``P / gamma^2`` into a filter in the problem's coordinates; the level is gamma^2."""
    storage = (P + P.T) / 2
    information = storage - scaled.problem.L.T @ scaled.problem.L / level
    P = np.asarray(np.linalg.inv(storage), dtype=np.float64)
    return scaled.solution(P, information, run)
