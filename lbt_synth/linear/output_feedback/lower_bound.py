"""Prove that no controller reaches a level of gamma, in closed form.

Two kinds of pairs are used. States and disturbances (x, w) that no measurement shows,
``C2 x + D21 w = 0``, leave the controller without a reason to act. Costates and error weights
(p, v) that no control moves, ``B2'p + D12'v = 0``, leave it without a means. Let the successors
``A x + B1 w`` have the second moments of the x and some growth G1 >= 0 more, those ``A'p + C1'v``
of the p and G2 >= 0 more. Then, whatever the controller,

    gamma^2 (|w|^2 + |v|^2) > |C1 x + D11 w|^2 + |B1'p + D11'v|^2 + 2 gamma ||G1^(1/2) G2^(1/2)||_*

(Frobenius norms, and the nuclear norm) by weak duality with the inequalities of P. Gahinet,
P. Apkarian, Int. J. Robust Nonlinear Control 4, 421 (1994), doi:10.1002/rnc.4590040403. Where
rounding makes a growth indefinite, the price of the shortfall is added on the left. A steady
oscillation has no growth but for rounding, and no price.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lbt_synth.errors import ProblemError, SynthesisError
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.infeasibility_proof import Witness, priced_growth, scaled_basis
from lbt_synth.linear.lyapunov import stationary_root
from lbt_synth.linear.matrix_functions import semidefinite_root
from lbt_synth.linear.riccati.dare import solve_dare
from lbt_synth.validation import FloatArray

_STEPS = 64  # of the recursion that bounds the storage matrix
_STEADY = 1e-12  # part of the states' moments by which those of an oscillation may change
_RANK = 1e-8  # share of the largest root of a cost that counts as none
_SINGULAR = 1e-15  # of what the largest control moves, that counts as none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WorstCase:
    """The loop of best control and worst disturbance at a level, as functions of the state."""

    A: FloatArray  # (n, n), stable
    C: FloatArray  # (p1, n), to the error
    entry: FloatArray  # (n, 1), state that the last, worst disturbance leaves
    error: FloatArray  # (p1, 1), and the error at that instant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlWitness:
    """Why no controller reaches a level."""

    reason: str  # the reason in words
    # states (n, r) and disturbances (m1, r) that no measurement shows
    unseen: Witness | None = None
    # costates (n, s) and weights of the error (p1, s) that no control moves
    unmoved: Witness | None = None


NO_PROOF = ControlWitness(reason="no proof was found")


@dataclass(frozen=True, slots=True)
class _Moments:
    """What a set of pairs gains and spends, and a root of its growth."""

    gained: float
    spent: float
    root: FloatArray  # (n, r)


def infeasible_control_level(plant: GeneralizedPlant, witness: ControlWitness) -> float:
    """Level of gamma below which a witness proves that no controller exists; 0 if it proves none.

    What measurements would show or controls move is removed from the pairs first.
    """
    pairs = (witness.unseen, True), (witness.unmoved, False)
    sides = [_moments(*_side(plant, turned), pair) for pair, turned in pairs if pair is not None]
    levels = [np.sqrt(side.gained / side.spent) for side in sides if side.spent > 0]
    if len(sides) == 2:
        levels.append(_coupled_level(*sides))
    return float(max(levels, default=0.0))


def _coupled_level(one: _Moments, two: _Moments) -> float:
    """Level that both sides prove together, at the best relative weight of the two.

    With the weights t and 1/t they prove all levels for which ``t a1 + a2 / t < 2 gamma s``, with
    ``a = gamma^2 spent - gained`` of each side and s the nuclear norm: at the best t, those of
    ``a1 a2 < gamma^2 s^2``, a quadratic inequality of gamma^2.
    """
    shared = float(np.linalg.norm(one.root.T @ two.root, "nuc"))
    if not one.spent * two.spent > 0:
        return 0.0
    first, second = one.gained / one.spent, two.gained / two.spent
    both = shared**2 / one.spent / two.spent
    root = np.hypot(first - second + both, 2 * np.sqrt(second * both))
    return float(np.sqrt((first + second + both + root) / 2))


def _moments(side: GeneralizedPlant, root: FloatArray, pairs: Witness) -> _Moments:
    """Evaluate pairs against the side in whose equation they are the costates, and its root."""
    states = pairs.states
    after, steady = _hide(side, states, pairs.disturbances)
    growth, size = after @ after.T - states @ states.T, float(np.sum(states**2))
    turning = states.shape[1] <= 2 and np.linalg.norm(growth) <= _STEADY * size
    if steady is not None and turning:
        return steady
    basis, inverse = storage_coordinates(root)
    states = basis @ (inverse @ states)
    after, within = _hide(side, states, pairs.disturbances)
    priced = priced_growth(after, states, basis, inverse)
    if within is None or priced is None:
        return _Moments(0.0, 1.0, np.zeros_like(states))
    grown, price = priced
    return _Moments(within.gained, within.spent + price, grown)


def _hide(
    side: GeneralizedPlant, states: FloatArray, signals: FloatArray
) -> tuple[FloatArray, _Moments | None]:
    """Hide signals by the least change; return successors (n, r), and moments if it hides them."""
    shown = side.B2.T @ states + side.D12.T @ signals
    signals = signals - np.linalg.pinv(side.D12.T, rcond=1e-10) @ shown
    seen, cancelled = side.B2.T @ states, side.D12.T @ signals
    size = np.linalg.norm(seen) + np.linalg.norm(cancelled)
    gain = side.B1.T @ states + side.D11.T @ signals
    moments = _Moments(float(np.sum(gain**2)), float(np.sum(signals**2)), np.zeros_like(states))
    is_hidden = np.linalg.norm(seen + cancelled) <= _STEADY * size
    return side.A.T @ states + side.C1.T @ signals, moments if is_hidden else None


def storage_coordinates(root: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T (n, r) with ``T T'`` the storage of a root, and its left inverse.

    Directions below a share of the largest are left out.
    """
    spread = np.linalg.norm(root, axis=1)
    spread = np.where(spread > 0, spread, 1.0)
    directions, sizes, _ = np.linalg.svd(root / spread[:, None], full_matrices=False)
    kept = sizes > _RANK * sizes[0]
    return scaled_basis(spread, directions[:, kept], sizes[kept])


def storage_root(side: GeneralizedPlant) -> FloatArray:
    """Return a root (n, r) of what any law leaves: the least cost, or some steps to it.

    A root has costs to the square of rounding, which still limit what a storage matrix may be. The
    law is improved by the root itself: what an inaccurate law leaves is too much.
    """
    size = np.linalg.norm(np.vstack([side.B2, side.D12]), axis=0)
    moves = size > 0
    A, B, D12 = side.A, side.B2[:, moves] / size[moves], side.D12[:, moves] / size[moves]
    C1, Q = side.C1, side.C1.T @ side.C1
    with suppress(ProblemError, SynthesisError):  # a singular problem has no stabilising law
        law = solve_dare(A, B, Q, D12.T @ D12, C1.T @ D12).gain_feedback
        root = stationary_root((A - B @ law).T, (C1 - D12 @ law).T)
        moved, left = np.vstack([root.T @ B, D12]), np.vstack([root.T @ A, C1])
        law = np.linalg.lstsq(moved, left, rcond=_SINGULAR)[0]
        improved = stationary_root((A - B @ law).T, (C1 - D12 @ law).T)
        return improved if np.all(np.isfinite(improved)) else root
    root = np.zeros((len(A), 1))
    for _ in range(_STEPS):  # what is left after any control lies beside all that controls move
        moved, left = np.vstack([root.T @ B, D12]), np.vstack([root.T @ A, C1])
        directions, sizes, _ = np.linalg.svd(moved, full_matrices=False)
        basis = directions[:, sizes > _SINGULAR * sizes.max(initial=0.0)]
        beside = left - basis @ (basis.T @ left)
        root = np.asarray(np.linalg.qr(beside)[1].T)
    return root


@lru_cache(maxsize=4)
def _side(plant: GeneralizedPlant, turned: bool) -> tuple[GeneralizedPlant, FloatArray]:
    """Return a side, estimation turned, and its root, once for all that may prove something."""
    side = plant.transposed() if turned else plant
    return side, storage_root(side)


def last_step(worst: WorstCase, X: FloatArray) -> Witness:
    """Return the burst that ends with the worst last disturbance."""
    burst = _burst(worst, X, worst.entry)
    return replace(
        burst,
        states=np.hstack([burst.states, X @ worst.entry]),
        disturbances=np.hstack([burst.disturbances, worst.error]),
    )


def _burst(worst: WorstCase, X: FloatArray, seed: FloatArray) -> Witness:
    """Return the pairs along the worst trajectory from a seed (n, 1)."""
    roots = stationary_root(worst.A, seed)
    with np.errstate(all="ignore"):  # of a worst case that rounding makes unstable
        return Witness(states=X @ worst.A @ roots, disturbances=worst.C @ roots)


def coupled_bursts(
    control: WorstCase, X: FloatArray, estimation: WorstCase, Y: FloatArray
) -> tuple[Witness, Witness]:
    """Return the bursts of both sides that meet where the product of X and Y is largest."""
    root = semidefinite_root(X)
    meeting = root @ np.linalg.eigh(root.T @ Y @ root)[1][:, -1:]
    return _burst(estimation, Y, meeting), _burst(control, X, Y @ meeting)
