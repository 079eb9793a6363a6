"""Disturbances that no filter sees, from the gamma-Riccati equation near its least gamma."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh, null_space

from lbt_synth.linear.estimation_problem import EstimationProblem
from lbt_synth.linear.filter_gains import decorrelated
from lbt_synth.linear.infeasibility_proof import Witness, infeasible_level
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.validation import FloatArray, frozen

_SLOW = 0.999  # a backward pole beyond it may be that of a sinusoid


def worst_invisible(
    problem: EstimationProblem, P: FloatArray, gamma: float, covariance: FloatArray
) -> Witness:
    """Return the disturbance that proves most against levels below gamma.

    Two kinds are tried. A burst that ends in the direction where ``gamma^2 I - L P L'`` is least:
    with the costate p, ``p(j) = (I + W P)^-1 A' p(j+1)``, ``x(j) = P p(j)``, ``w(j) = B' p(j+1)``
    is the dearest past that leads there. And a sinusoid at the frequency of the slowest pole of
    that recursion, for where it is a steady oscillation that limits gamma. Shapes: P (n, n),
    covariance (n, n).
    """
    A, B, _ = decorrelated(problem)
    C, L = problem.C, problem.L
    W = C.T @ np.linalg.solve(problem.R, C) - L.T @ L / gamma**2
    backward = np.asarray(np.linalg.solve(np.eye(len(A)) + W @ P, A.T), dtype=np.float64)
    worst = np.linalg.eigh(L @ P @ L.T)[1][:, -1]
    end = L.T @ worst
    values, vectors = np.linalg.eigh(stationary_covariance(backward, np.outer(end, end)))
    costates = vectors * np.sqrt(np.maximum(values, 0))
    candidates = [_completed(problem, P @ backward @ costates, B.T @ costates)]
    poles = np.linalg.eigvals(backward)
    slow = poles[(np.abs(poles) > _SLOW) & (poles.imag >= 0)]
    candidates += [_sinusoid(problem, float(np.angle(pole))) for pole in slow]
    return max(candidates, key=lambda witness: infeasible_level(problem, witness, covariance))


def _completed(problem: EstimationProblem, states: FloatArray, disturbances: FloatArray) -> Witness:
    """Add the measurement noise that hides the states."""
    hiding = -problem.D.T @ np.linalg.solve(problem.R, problem.C @ states)
    return Witness(states=frozen(states), disturbances=frozen(disturbances + hiding))


def _sinusoid(problem: EstimationProblem, angle: float) -> Witness:
    """Return the steady sinusoid of one frequency, invisible, with most z for its w."""
    A, B, C, D, L = problem.A, problem.B, problem.C, problem.D, problem.L
    n = len(A)
    steady = np.block([[np.exp(1j * angle) * np.eye(n) - A, -B], [C, D]])
    pairs = null_space(steady)
    x, w = pairs[:n], pairs[n:]
    gained, spent = (L @ x).conj().T @ (L @ x), w.conj().T @ w
    floor = 1e-13 * np.trace(spent).real * np.eye(len(spent))
    best = pairs @ eigh(gained, spent + floor)[1][:, -1]
    both = np.stack([best.real, best.imag], axis=1)
    return Witness(states=frozen(both[:n]), disturbances=frozen(both[n:]))
