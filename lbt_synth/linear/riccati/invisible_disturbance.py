"""Find disturbances that no filter sees, by the gamma-Riccati equation near its least gamma."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh, null_space

from lbt_synth.linear.estimation_problem import EstimationProblem, decorrelate
from lbt_synth.linear.infeasibility_proof import Witness, infeasible_level
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.validation import FloatArray, frozen_copy

_SLOW = 0.999  # a pole of the backward recursion beyond this may belong to a sinusoid


def worst_invisible_disturbance(
    problem: EstimationProblem, P: FloatArray, gamma: float, covariance: FloatArray
) -> Witness:
    """Return the disturbance that proves most against levels below gamma.

    Two kinds are tried. One is a burst that ends in the direction in which
    ``gamma^2 I - L P L'`` is least: with the costate p, ``p(j) = (I + W P)^-1 A' p(j+1)``,
    ``x(j) = P p(j)``, ``w(j) = B' p(j+1)`` is the worst past that leads there. The other is a
    sinusoid at the frequency of the slowest pole of that recursion, for problems in which a
    steady oscillation limits gamma. P and covariance are (n, n).
    """
    A, B, _ = decorrelate(problem)
    C, L = problem.C, problem.L
    W = C.T @ np.linalg.solve(problem.R, C) - L.T @ L / gamma**2
    backward = np.asarray(np.linalg.solve(np.eye(len(A)) + W @ P, A.T), dtype=np.float64)
    worst = np.linalg.eigh(L @ P @ L.T)[1][:, -1]
    end = L.T @ worst
    values, vectors = np.linalg.eigh(stationary_covariance(backward, np.outer(end, end)))
    costates = vectors * np.sqrt(np.maximum(values, 0))
    candidates = [_hide(problem, P @ backward @ costates, B.T @ costates)]
    poles = np.linalg.eigvals(backward)
    slow = poles[(np.abs(poles) > _SLOW) & (poles.imag >= 0)]
    candidates += [_sinusoid(problem, float(np.angle(pole))) for pole in slow]
    return max(candidates, key=lambda witness: infeasible_level(problem, witness, covariance))


def _hide(problem: EstimationProblem, states: FloatArray, disturbances: FloatArray) -> Witness:
    """Add the measurement noise that hides the states."""
    hiding = -problem.D.T @ np.linalg.solve(problem.R, problem.C @ states)
    return Witness(states=frozen_copy(states), disturbances=frozen_copy(disturbances + hiding))


def _sinusoid(problem: EstimationProblem, angle: float) -> Witness:
    """Return the invisible sinusoid of one frequency that has the most z for its w."""
    A, B, C, D, L = problem.A, problem.B, problem.C, problem.D, problem.L
    n = len(A)
    steady = np.block([[np.exp(1j * angle) * np.eye(n) - A, -B], [C, D]])
    pairs = null_space(steady)
    x, w = pairs[:n], pairs[n:]
    gained, spent = (L @ x).conj().T @ (L @ x), w.conj().T @ w
    floor = 1e-13 * np.trace(spent).real * np.eye(len(spent))
    best = pairs @ eigh(gained, spent + floor)[1][:, -1]
    both = np.stack([best.real, best.imag], axis=1)
    return Witness(states=frozen_copy(both[:n]), disturbances=frozen_copy(both[n:]))
