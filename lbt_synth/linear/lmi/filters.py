"""Solve for the Kalman predictor and for the least gamma of one by semidefinite programmes.

For the least gamma the gain is eliminated: with N a basis of the null space of ``[C D]``, a filter
with error norm below gamma exists if and only if some P satisfies::


    Nx'P Nx + gamma^2 Nw'Nw - (A Nx + B Nw)' P (A Nx + B Nw) - (L Nx)'(L Nx) > 0
    P - L'L > 0

P is the storage matrix of the error system; ``gamma^2 P^-1`` takes the place of
the Riccati solution, and the gain follows from it in closed form. Elimination:
P. Gahinet, P. Apkarian, Int. J. Robust Nonlinear Control 4, 421 (1994),
doi:10.1002/rnc.4590040403.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space

from lbt_synth.errors import NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem, decorrelate
from lbt_synth.linear.infeasibility_proof import Witness, whitening_coordinates
from lbt_synth.linear.lmi.conic_program import require_optimum
from lbt_synth.linear.lmi.programmes import solve, symmetric_variable, symmetrise
from lbt_synth.linear.matrix_functions import part_labels, semidefinite_root
from lbt_synth.linear.riccati.filtering import FilterRiccati
from lbt_synth.validation import FloatArray, IntArray, frozen_copy

_ADVICE = 'Try route="riccati".'


class _Balanced:
    """A problem in states of which ``coordinates`` is the identity, with unit noise.

    These decide how accurate a solver is, not what it finds.
    """

    def __init__(self, problem: EstimationProblem, coordinates: FloatArray, scale: float) -> None:
        A_s, B_s, self.injection = decorrelate(problem)
        self.basis, inverse = whitening_coordinates(coordinates)
        self.whitening = np.linalg.inv(np.linalg.cholesky(problem.R))
        self.problem = EstimationProblem(
            A=inverse @ A_s @ self.basis,
            B=inverse @ B_s,
            C=self.whitening @ problem.C @ self.basis,
            D=self.whitening @ problem.D,
            L=problem.L @ self.basis / scale,
        )

    def filter(self, P: FloatArray, information: FloatArray, run: tuple[str, int]) -> FilterRiccati:
        """Return the filter of a solution P and of the information that it has of the states."""
        C = self.problem.C
        try:  # the inverse of the information may be singular, the gain stays finite
            gain_filter = np.linalg.solve(information + C.T @ C, C.T)
        except np.linalg.LinAlgError as error:
            raise NumericalError(
                f"the inequality's storage matrix has no gain: {error}. {_ADVICE}", status=run[0]
            ) from error
        gain = self.basis @ self.problem.A @ gain_filter @ self.whitening + self.injection
        return FilterRiccati(
            P=frozen_copy(self.basis @ P @ self.basis.T),
            gain_predictor=frozen_copy(gain),
            status=run[0],
            iterations=run[1],
        )


def kalman_sdp(
    problem: EstimationProblem, *, coordinates: FloatArray, scale: float
) -> FilterRiccati:
    """Maximise tr P subject to ``[[APA' + BB' - P, APC'], [CPA', DD' + CPC']] >= 0``, ``P >= 0``.

    The stabilising solution of the filter Riccati equation is the greatest P that satisfies the
    inequality (S. Boyd et al., "Linear Matrix Inequalities in System and Control Theory", SIAM
    (1994), doi:10.1137/1.9781611970777).
    """
    balanced = _Balanced(problem, coordinates, scale)
    A, B, C, R = (getattr(balanced.problem, name) for name in "ABCR")
    P = symmetric_variable(_parts(balanced.problem)[0])
    riccati = cp.bmat([[A @ P @ A.T + B @ B.T - P, A @ P @ C.T], [C @ P @ A.T, R + C @ P @ C.T]])
    run = solve(cp.Maximize(cp.trace(P)), [symmetrise(riccati) >> 0, P >> 0])
    require_optimum(run, "the semidefinite programme of the Kalman filter", _ADVICE)
    return balanced.filter(P.value, np.linalg.inv(P.value), run)


def least_gamma_lmi(
    problem: EstimationProblem, *, coordinates: FloatArray, scale: float
) -> tuple[FilterRiccati, Witness]:
    """Find the least gamma, and a filter that reaches it; the dual solution is its witness."""
    balanced = _Balanced(problem, coordinates, scale)
    A, B, L = (getattr(balanced.problem, name) for name in "ABL")
    hidden, parts = _invisible_basis(balanced.problem)
    Nx, Nw = np.split(hidden, [len(A)])
    P, level = symmetric_variable(_parts(balanced.problem)[0]), cp.Variable(nonneg=True)
    step, seen = A @ Nx + B @ Nw, L @ Nx
    supplied = Nx.T @ P @ Nx + level * (Nw.T @ Nw)
    dissipation = symmetrise(supplied - step.T @ P @ step - seen.T @ seen) >> 0
    run = solve(cp.Minimize(level), [dissipation, P - L.T @ L >> 0])
    require_optimum(run, "the least gamma's semidefinite programme", _ADVICE)
    storage = (P.value + P.value.T) / 2 / level.value
    solution = balanced.filter(np.linalg.inv(storage), storage - L.T @ L / level.value, run)
    moments = np.where(parts[:, None] == parts, dissipation.dual_value, 0.0)
    pairs = hidden @ semidefinite_root(moments)
    states, disturbances = np.split(pairs, [len(A)])
    return solution, Witness(states=balanced.basis @ states, disturbances=disturbances)


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
