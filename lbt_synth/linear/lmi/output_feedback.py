"""Controllers by linear matrix inequalities: the least gamma, and the least variance below one.

The least gamma comes without the matrices of its controller: P. Gahinet, P. Apkarian, Int. J.
Robust Nonlinear Control 4, 421 (1994), doi:10.1002/rnc.4590040403, theorem 4.2 in discrete time. It
asks nothing of D12 and D21. The dual solution proves that no controller reaches less.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space

from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.linear.lmi.conic_program import require_optimum
from lbt_synth.linear.lmi.programmes import norm_below, solve, symmetrise
from lbt_synth.linear.matrix_functions import semidefinite_root
from lbt_synth.linear.output_feedback.lower_bound import (
    ControlWitness,
    storage_coordinates,
    storage_root,
)
from lbt_synth.linear.output_feedback.two_riccati import FreeParameter
from lbt_synth.validation import FloatArray

_REASON = "the dual of the matrix inequalities has a point there"


def least_level_lmi(plant: GeneralizedPlant, scale: float) -> tuple[float, ControlWitness]:
    """Return the least gamma of the programme, and the witness of its dual solution.

    The least cost of each side gives coordinates in which its storage matrix is at most gamma; the
    scale is the size of gamma.
    """
    scaled = replace(plant, C1=plant.C1 / scale, D11=plant.D11 / scale, D12=plant.D12 / scale)
    level = cp.Variable()
    sides = [_Storage(scaled.transposed()), _Storage(scaled)]
    constraints = [side.dissipation(level) << 0 for side in sides]
    shared = sides[0].basis.T @ sides[1].basis
    coupling = cp.bmat([[sides[0].storage, shared], [shared.T, sides[1].storage]])
    run = solve(cp.Minimize(level), [*constraints, symmetrise(coupling) >> 0])
    require_optimum(run, "the least gamma's semidefinite programme", 'Try route="riccati".')
    unseen, unmoved = (
        side.pairs(each.dual_value) for side, each in zip(sides, constraints, strict=True)
    )
    unmoved = replace(unmoved, disturbances=unmoved.disturbances / scale)
    witness = ControlWitness(unseen=unseen, unmoved=unmoved, reason=_REASON)
    return float(level.value) * scale, witness


class _Storage:
    """The storage matrix of one side, and the pairs that its constraint hides."""

    def __init__(self, side: GeneralizedPlant) -> None:
        self.side = side
        self.basis, self.inverse = storage_coordinates(storage_root(side))
        if not self.basis.size:  # old versions of cvxpy have no empty variables
            self.basis, self.inverse = np.zeros((len(side.A), 1)), np.zeros((1, len(side.A)))
        self.size = self.basis.shape[1]
        self.hidden = null_space(np.hstack([side.B2.T @ self.basis, side.D12.T]))
        self.storage = cp.Variable((self.size, self.size), symmetric=True)

    def dissipation(self, level: Any) -> Any:
        """Return the matrix that must be negative."""
        side, states, signals = self.side, self.hidden[: self.size], self.hidden[self.size :]
        x = self.basis @ states
        after = self.inverse @ (side.A.T @ x + side.C1.T @ signals)
        gained = side.B1.T @ x + side.D11.T @ signals
        growth = after.T @ self.storage @ after - states.T @ self.storage @ states
        spent = growth - level * (signals.T @ signals)
        return symmetrise(cp.bmat([[spent, gained.T], [gained, -level * np.eye(len(gained))]]))

    def pairs(self, dual: FloatArray) -> Witness:
        """Return the pairs of a dual solution."""
        count = self.hidden.shape[1]
        moments = self.hidden @ semidefinite_root(dual[:count, :count])
        return Witness(states=self.basis @ moments[: self.size], disturbances=moments[self.size :])


def least_variance_below(
    loop: FreeParameter, gamma: float, taps: int, frequency_hz: FloatArray
) -> FloatArray:
    """Return the taps (T, m2, p2) of the least ``|Q|`` with the loop below gamma at frequencies.

    T12 is inner and T21 co-inner: with their orthogonal complements the loop is
    ``[[E11 + Q, E12], [E21, E22]]``, of which Q moves the first block alone.
    """
    m2, p2 = loop.T12.B.shape[1], len(loop.T21.C)
    Q = cp.Variable((m2, p2 * taps))
    z = np.exp(2j * np.pi * frequency_hz * loop.T11.dt_s)
    parts = (s.frequency_response(frequency_hz) for s in (loop.T11, loop.T12, loop.T21))
    constraints = []
    for point, T11, T12, T21 in zip(z, *parts, strict=True):
        left, right = _completed(T12), _completed(T21.conj().T)
        fixed = left.conj().T @ T11 @ right / gamma
        powers = np.kron((point ** -np.arange(taps))[:, None], np.eye(p2))  # (T p2, p2)
        place = np.eye(len(fixed), m2)
        wide = np.eye(p2, fixed.shape[1])
        real = fixed.real + place @ (Q @ powers.real) @ wide / gamma
        imaginary = fixed.imag + place @ (Q @ powers.imag) @ wide / gamma
        constraints.append(norm_below(real, imaginary, 1.0))
    run = solve(cp.Minimize(cp.norm(Q, "fro")), constraints)
    require_optimum(
        run, "the programme of the mixed controller", "Try a larger gamma, or more taps."
    )
    return np.moveaxis(np.asarray(Q.value).reshape(m2, taps, p2), 1, 0)


def _completed(columns: FloatArray) -> FloatArray:
    """Return a unitary matrix that begins with orthonormal columns."""
    full = np.linalg.qr(columns, mode="complete")[0]
    full[:, : columns.shape[1]] = columns
    return np.asarray(full)
