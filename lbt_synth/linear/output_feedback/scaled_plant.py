"""The plant that is solved: one that can be stabilised, in units of size one, and regular."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.errors import DetectabilityError
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.matrix_functions import nearest_powers_of_two
from lbt_synth.linear.output_feedback.two_riccati import TwoRiccati
from lbt_synth.linear.riccati.dare import unstable_hidden_mode
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

_LISTED = 4  # states that a message names
_PART = 1e-10  # of the largest singular value, below which a channel cancels nothing
_SHARE = 1e-6  # of the largest entry, below which a state has no part in a mode


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaledPlant:
    """A plant as it was given, and as it is solved."""

    given: GeneralizedPlant
    plant: GeneralizedPlant  # states and signals scaled by powers of two
    unit: float  # a level of the scaled plant over that of the given one
    controls: FloatArray  # (m2,) u of a unit of the scaled u
    measurements: FloatArray  # (p2,) scaled y of a unit of y

    def closed_loop(self, controller: StateSpace) -> tuple[StateSpace, StateSpace]:
        """Return a controller of the scaled plant in the given units, and its loop."""
        K, u = controller, self.controls[:, None]
        K = replace(K, B=K.B * self.measurements, C=u * K.C, D=u * K.D * self.measurements)
        return K, self.given.closed_loop(K)

    def equations(self, share: float) -> TwoRiccati:
        """Return the equations of the plant, with a share of errors and disturbances added."""
        return TwoRiccati(regularise(self.plant, share) if share else self.plant)


def scaled_plant(plant: GeneralizedPlant) -> ScaledPlant:
    """Return the form in which a plant is solved; DetectabilityError if nothing stabilises it.

    States are balanced, and errors, disturbances, controls and measurements have size one, so that
    no unit is singular. What a control may cancel, D11, has no part in the sizes.
    """
    require_instance(plant, GeneralizedPlant, "plant")
    require_stabilisable(plant)
    sizes = _size(plant.C1, plant.D12), _size(plant.B1, plant.D21)
    z, w = (1 / float(nearest_powers_of_two(np.array([size]))[0]) for size in sizes)
    P = replace(
        plant,
        B1=w * plant.B1,
        C1=z * plant.C1,
        D11=z * w * plant.D11,
        D12=z * plant.D12,
        D21=w * plant.D21,
    )
    P = P.with_whole(P.whole.balanced())
    controls, measurements = _units(P.B2, P.D12), _units(P.C2.T, P.D21.T)
    y = measurements[:, None]
    scaled = replace(
        P,
        B2=P.B2 * controls,
        D12=P.D12 * controls,
        C2=y * P.C2,
        D21=y * P.D21,
        D22=y * P.D22 * controls,
    )
    return ScaledPlant(
        given=plant, plant=scaled, unit=z * w, controls=controls, measurements=measurements
    )


def _units(into: FloatArray, through: FloatArray) -> FloatArray:
    """Return powers of two that make columns of two matrices together of size about one."""
    size = np.hypot(np.linalg.norm(into, axis=0), np.linalg.norm(through, axis=0))
    return 1 / nearest_powers_of_two(size)


def regularise(plant: GeneralizedPlant, share: float) -> GeneralizedPlant:
    """Return the plant with small errors of each control and state, and small disturbances of both.

    ``share`` is their part of the plant's own errors and disturbances. A controller leaves no
    less in the regularised plant than in the plant itself, and in the limit as much. Where a
    constant control ``u = K y`` cancels much of D11, the errors are those of the distance from it,
    and it makes nothing of the disturbances of the measurements: they are relative to what is left.
    """
    P, n = plant, len(plant.A)
    m1, m2, p1, p2 = P.sizes
    K = _cancelling(P)
    error = share * _size(P.C1 + P.D12 @ K @ P.C2, P.D12, P.D11 + P.D12 @ K @ P.D21)
    push = share * _size(P.B1 + P.B2 @ K @ P.D21, P.D21, P.D11 + P.D12 @ K @ P.D21)
    C1 = np.vstack([P.C1, -error * K @ P.C2, error * np.eye(n)])
    D12 = np.vstack([P.D12, error * np.eye(m2), np.zeros((n, m2))])
    B1 = np.hstack([P.B1, -push * P.B2 @ K, push * np.eye(n)])
    D21 = np.hstack([P.D21, push * np.eye(p2), np.zeros((p2, n))])
    D11 = np.zeros((len(C1), B1.shape[1]))
    D11[:p1] = np.hstack([P.D11, -push * P.D12 @ K, np.zeros((p1, n))])
    D11[p1 : p1 + m2, : m1 + p2] = np.hstack([-error * K @ P.D21, -error * push * K])
    return replace(P, B1=B1, C1=C1, D11=D11, D12=D12, D21=D21)


def _cancelling(plant: GeneralizedPlant) -> FloatArray:
    """Return the constant control (m2, p2) that leaves least of D11, if it makes nothing larger."""
    P = plant
    K = -np.linalg.pinv(P.D12, rcond=_PART) @ P.D11 @ np.linalg.pinv(P.D21, rcond=_PART)
    through = P.D11 + P.D12 @ K @ P.D21
    cancelled = _size(P.C1 + P.D12 @ K @ P.C2, P.D12, through)
    cancelled *= _size(P.B1 + P.B2 @ K @ P.D21, P.D21, through)
    left = _size(P.C1, P.D12, P.D11) * _size(P.B1, P.D21, P.D11)
    return K if cancelled < left else 0 * K


def _size(*parts: FloatArray) -> float:
    return max(float(np.linalg.norm(part, 2)) for part in parts) or 1.0


def require_stabilisable(plant: GeneralizedPlant) -> None:
    """Raise if a mode that does not decay is not reached by u, or not seen by y."""
    reached = unstable_hidden_mode(plant.A.T, plant.B2.T, drive=plant.C1.T)
    seen = unstable_hidden_mode(plant.A, plant.C2, drive=plant.B1)
    for value, A, C, words in (
        (reached, plant.A.T, plant.B2.T, "no control reaches it. Give it a control"),
        (seen, plant.A, plant.C2, "no measurement sees it. Measure it"),
    ):
        if value is None:
            continue
        vector = _null_vector(A, C, value)
        raise DetectabilityError(
            f"no controller stabilises the plant: its mode at {_number(value)} does not decay, and "
            f"{words}, or take it out of the plant (a weight with such a pole: let it decay a "
            f"little). The mode is made of the states {_states(vector)}.",
            eigenvalue=value,
            eigenvector=frozen_copy(np.abs(vector)),
        )


def _null_vector(A: FloatArray, C: FloatArray, value: complex) -> FloatArray:
    """Return the unit vector that C does not see and A multiplies by a value, (n,) complex."""
    pencil = np.vstack([A - value * np.eye(len(A)), C])
    return np.asarray(np.linalg.svd(pencil)[2][-1].conj())


def _states(vector: FloatArray) -> str:
    """Name the states that have a part in a mode, the largest first."""
    size = np.abs(vector)
    order = [int(i) for i in np.argsort(-size) if size[i] > _SHARE * size.max()]
    named = ", ".join(f"{i} ({size[i] / size.max():.3g})" for i in order[:_LISTED])
    return named + (", ..." if len(order) > _LISTED else "")


def _number(value: complex) -> str:
    return f"{value.real + 0.0:.6g}" if abs(value.imag) <= 1e-9 * abs(value) else f"{value:.6g}"
