"""Prove that a level of gamma cannot be reached, by disturbances that no filter can see.

A disturbance that makes every measurement zero leaves every filter with the estimate
zero, so its estimation error is the signal z itself. A set of such disturbances is
written as moments: the columns of ``states`` and ``disturbances`` are pairs (x, w) whose
measurement ``C x + D w`` is zero, and whose successors ``A x + B w`` have at least the
second moments of the states. Then, whatever the filter,

    gamma^2 >= ||L (A states + B disturbances)||^2 / ||disturbances||^2      (Frobenius)

by weak duality with the linear matrix inequality of the filter, of whose dual the moments are
a point. If rounding breaks the "at least", the price of the shortfall is added to the denominator.

With a longer period there are pairs at each phase, and successors have at least the moments of the
states of the next phase. A witness begins at phase 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy.linalg import eigh, null_space

from lbt_synth.errors import DimensionError
from lbt_synth.linear.estimation_problem import (
    EstimationProblem,
    decorrelate,
    error_units,
    scale_states,
)
from lbt_synth.linear.lyapunov import stationary_root
from lbt_synth.linear.matrix_functions import as_stack, component_labels
from lbt_synth.validation import FloatArray, matrix, set_fields

_RANK_TOLERANCE = 1e-13
_SLOW = 0.99  # a pole of a worst case beyond this may belong to a steady oscillation
_SMALLEST_SCALE = 1e-7  # of a state, as a part of the largest standard deviation
_STRAYED = 1e-10  # share of the successors that may lie outside of the range of every storage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Witness:
    """Pairs of states and disturbances that no measurement shows."""

    states: FloatArray  # (n, r), or (N, n, r) of each phase: states x of the problem
    disturbances: FloatArray  # (p, r) or (N, p, r): the disturbance w of each state

    def __post_init__(self) -> None:
        states = matrix(self.states, "states", stacked=True)
        columns = (states.shape[-1], f"to match the states {states.shape}")
        disturbances = matrix(self.disturbances, "disturbances", cols=columns, stacked=True)
        if states.ndim > 3 or disturbances.shape[:-2] != states.shape[:-2]:
            raise DimensionError(
                f"states and disturbances must have the same phases; got {states.shape} and "
                f"{disturbances.shape}."
            )
        if len(states) == 1 and states.ndim == 3:
            states, disturbances = states[0], disturbances[0]
        set_fields(self, states=states, disturbances=disturbances)

    @property
    def period(self) -> int:
        """Number of phases N; 1 for a problem that is constant."""
        return len(self.states) if self.states.ndim == 3 else 1


def infeasible_level(problem: EstimationProblem, witness: Witness, covariance: FloatArray) -> float:
    """Level of gamma below which a witness proves that no filter exists; 0 if it proves nothing.

    What the measurements would show is removed first. The covariance, (n, n) or (N, n, n), is the
    least one of the prediction error (Kalman). It bounds the storage matrix of every filter,
    ``P <= gamma^2 covariance^-1``, and weighs the shortfall by rounding.
    """
    if witness.period != problem.period:
        raise DimensionError(
            f"the witness must have the period of the problem, {problem.period}; got "
            f"{witness.period}."
        )
    covariances, disturbances = as_stack(covariance), as_stack(witness.disturbances)
    spaces = [whitening_coordinates(P) for P in covariances]
    states = [  # in the space of a filter's error
        basis @ (inverse @ x)
        for x, (basis, inverse) in zip(as_stack(witness.states), spaces, strict=True)
    ]
    gained = spent = 0.0
    for t, (x, w) in enumerate(zip(states, disturbances, strict=True)):
        A, B, C, D = problem.read_parts(t)
        w = w - D.T @ np.linalg.solve(D @ D.T, C @ x + D @ w)
        after, onward = A @ x + B @ w, (t + 1) % problem.period
        growth = priced_growth(after, states[onward], *spaces[onward])
        if growth is None:
            return 0.0
        root, price = growth
        gained += float(np.sum((problem.L @ states[onward]) ** 2) + np.sum((problem.L @ root) ** 2))
        spent += float(np.sum(w**2)) + price
    return float(np.sqrt(gained / spent)) if spent > 0 else 0.0


def priced_growth(
    after: FloatArray, states: FloatArray, basis: FloatArray, inverse: FloatArray
) -> tuple[FloatArray, float] | None:
    """Return a root (n, r) of the moments that successors have more than states, and its price.

    The price is that of a shortfall by rounding. The moments are formed in the coordinates of a
    storage, its basis (n, r) and inverse; None where successors stray from its range.
    """
    inner, before = inverse @ after, inverse @ states  # squares would double their rounding
    deviation = np.linalg.norm(basis, axis=1, keepdims=True)
    scale = np.maximum(deviation, _SMALLEST_SCALE * deviation.max(initial=0.0))
    scale = np.where(scale > 0, scale, 1.0)
    strayed = np.linalg.norm((after - basis @ inner) / scale)
    if strayed > _STRAYED * np.linalg.norm(after / scale):
        return None
    values, vectors = np.linalg.eigh(inner @ inner.T - before @ before.T)
    root = basis @ (vectors * np.sqrt(np.maximum(values, 0)))
    return root, -float(values[values < 0].sum())


def whitening_coordinates(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Basis T with ``covariance = T T'``, and its left inverse; null directions are dropped.

    A vector of the basis is of states that are correlated: it joins no independent parts.
    """
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    spread = np.where(spread > 0, spread, 1.0)
    label = component_labels(covariance != 0)
    sizes: list[FloatArray] = []
    directions: list[FloatArray] = []
    for part in range(np.max(label) + 1):
        rows = np.flatnonzero(label == part)
        units = spread[rows]
        values, vectors = np.linalg.eigh(covariance[np.ix_(rows, rows)] / np.outer(units, units))
        kept = values > _RANK_TOLERANCE * values[-1]
        sizes.append(np.sqrt(values[kept]))
        directions.append(np.eye(len(label))[:, rows] @ vectors[:, kept])
    return scaled_basis(spread, np.hstack(directions), np.concatenate(sizes))


def scaled_basis(
    spread: FloatArray, directions: FloatArray, sizes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Orthonormal directions (n, r) of sizes (r,) in units (n,), as a basis; its left inverse."""
    basis, inverse = spread[:, None] * directions * sizes, (directions / sizes).T / spread
    return np.asarray(basis, dtype=np.float64), np.asarray(inverse, dtype=np.float64)


def worst_invisible_disturbance(
    problem: EstimationProblem, P: FloatArray, gamma: float, covariance: FloatArray
) -> Witness:
    """Return the disturbance that proves most against levels below gamma.

    Two kinds are tried: a burst, and, with a period of 1, a sinusoid at the frequency of the
    slowest pole of its recursion, for problems in which a steady oscillation limits gamma. P and
    covariance are (n, n) or (N, n, n).
    """
    units = error_units(covariance)
    problem = scale_states(problem, units)
    P, covariance = P / units / units.T, covariance / units / units.T
    candidates = [_worst_burst(problem, P, gamma)]
    if problem.period == 1:
        system, gain = problem.read_parts(0), (problem.L, np.zeros_like(problem.L @ problem.B))
        angles = slow_angles(_backward(problem, 0, P, gamma)[0])
        candidates += [steady_oscillation(system, gain, angle) for angle in angles]
    best = max(candidates, key=lambda witness: infeasible_level(problem, witness, covariance))
    return replace(best, states=units * best.states)


def _worst_burst(problem: EstimationProblem, P: FloatArray, gamma: float) -> Witness:
    """Return the witness of the worst past that ends where ``gamma^2 I - L P L'`` is least."""
    N, L, phases = problem.period, problem.L, as_stack(P)
    top = [np.linalg.eigh(L @ X @ L.T) for X in phases]
    last = int(np.argmax([values[-1] for values, _ in top]))
    end = L.T @ top[last][1][:, -1]
    steps = [_backward(problem, t, X, gamma) for t, X in enumerate(phases)]
    order = [(last + k) % N for k in range(N)]
    around = reduce(np.matmul, (steps[t][0] for t in order))
    costates = stationary_root(around, end[:, None])  # of the phase where the burst ends
    if not np.all(np.isfinite(costates)):  # a recursion that rounding makes unstable
        costates = end[:, None]
    pairs: dict[int, tuple[FloatArray, FloatArray]] = {}
    for t in reversed(order):
        (backward, B), (_, _, C, D) = steps[t], problem.read_parts(t)
        before = backward @ costates
        x = phases[t] @ before
        pairs[t] = x, B.T @ costates - D.T @ np.linalg.solve(D @ D.T, C @ x)
        costates = before
    states, disturbances = (
        np.stack(kind) for kind in zip(*(pairs[t] for t in range(N)), strict=True)
    )
    return Witness(states=states, disturbances=disturbances)


def _backward(
    problem: EstimationProblem, t: int, P: FloatArray, gamma: float
) -> tuple[FloatArray, FloatArray]:
    """Return ``(I + W P)^-1 A'`` of the costates' recursion, and B, without correlation."""
    (_, _, C, D), L = problem.read_parts(t), problem.L
    A, B, _ = decorrelate(problem, t)
    W = C.T @ np.linalg.solve(D @ D.T, C) - L.T @ L / gamma**2
    backward = np.linalg.solve(np.eye(len(A)) + W @ P, A.T)
    return np.asarray(backward, dtype=np.float64), B


def steady_oscillation(
    system: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    gain: tuple[FloatArray, FloatArray],
    angle: float,
) -> Witness:
    """Return the oscillation of one frequency that a system does not show, and that gains most.

    Of ``e^(j angle) x = A x + B w`` with ``C x + D w = 0``, the pair of the largest ``L x + M w``
    for its w; nothing where there is none.
    """
    (A, B, C, D), (L, M) = system, gain
    n = len(A)
    pairs = null_space(np.block([[np.exp(1j * angle) * np.eye(n) - A, -B], [C, D]]))
    if pairs.shape[1] == 0:
        return Witness(states=np.zeros((n, 1)), disturbances=np.zeros((B.shape[1], 1)))
    gained, disturbances = L @ pairs[:n] + M @ pairs[n:], pairs[n:]
    spent = disturbances.conj().T @ disturbances
    floor = 1e-13 * max(np.trace(spent).real, 1e-300) * np.eye(len(spent))
    best = pairs @ eigh(gained.conj().T @ gained, spent + floor)[1][:, -1]
    phases = np.stack([best.real, best.imag], axis=1)
    return Witness(states=phases[:n], disturbances=phases[n:])


def slow_angles(A: FloatArray) -> list[float]:
    """Return the angles of the slow poles of a recursion, the slowest first."""
    poles = np.linalg.eigvals(A)
    slow = poles[(np.abs(poles) > _SLOW) & (poles.imag >= 0)]
    return [float(np.angle(pole)) for pole in slow[np.argsort(-np.abs(slow))]]
