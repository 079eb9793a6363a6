"""Find the least gamma of a predictor by a semidefinite programme.

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


def least_gamma_lmi(
    problem: EstimationProblem, *, coordinates: FloatArray, scale: float
) -> tuple[FilterRiccati, Witness]:
    """Find the least gamma, and a filter that reaches it; the dual solution is its witness.

    The programme is in states of which ``coordinates``, (n, n), is the identity, with measurements
    of unit noise. These decide how accurate the solver is, not what it finds.
    """
    A_s, B_s, injection = decorrelate(problem)
    basis, inverse = whitening_coordinates(coordinates)
    whitening = np.linalg.inv(np.linalg.cholesky(problem.R))
    balanced = EstimationProblem(
        A=inverse @ A_s @ basis,
        B=inverse @ B_s,
        C=whitening @ problem.C @ basis,
        D=whitening @ problem.D,
        L=problem.L @ basis / scale,
    )
    A, B, C, L, n = balanced.A, balanced.B, balanced.C, balanced.L, balanced.n_states
    hidden, parts = _invisible_basis(balanced)
    Nx, Nw = hidden[:n], hidden[n:]
    P, level = symmetric_variable(_parts(balanced)[0]), cp.Variable(nonneg=True)
    step, seen = A @ Nx + B @ Nw, L @ Nx
    supplied = Nx.T @ P @ Nx + level * (Nw.T @ Nw)
    dissipation = symmetrise(supplied - step.T @ P @ step - seen.T @ seen) >> 0
    run = solve(cp.Minimize(level), [dissipation, P - L.T @ L >> 0])
    require_optimum(run, "the least gamma's semidefinite programme", _ADVICE)
    storage = (P.value + P.value.T) / 2 / level.value
    information = storage - L.T @ L / level.value
    try:  # Pt^-1 may be singular, the gain stays finite
        gain_filter = np.linalg.solve(information + C.T @ C, C.T)
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            f"the inequality's storage matrix has no gain: {error}. {_ADVICE}", status=run[0]
        ) from error
    solution = FilterRiccati(
        P=frozen_copy(basis @ np.linalg.inv(storage) @ basis.T),
        gain_predictor=frozen_copy(basis @ A @ gain_filter @ whitening + injection),
        gain_filter=frozen_copy(basis @ gain_filter @ whitening),
        status=run[0],
        iterations=run[1],
    )
    moments = np.where(parts[:, None] == parts, dissipation.dual_value, 0.0)
    pairs = hidden @ semidefinite_root(moments)
    return solution, Witness(states=basis @ pairs[:n], disturbances=pairs[n:])


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
