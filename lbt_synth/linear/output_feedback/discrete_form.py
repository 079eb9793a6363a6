"""The form in which a generalised plant is solved: discrete time, balanced states."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.continuous_system import ContinuousSystem
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.matrix_functions import nearest_powers_of_two
from lbt_synth.linear.output_feedback.existence import require_stabilisable
from lbt_synth.linear.output_feedback.least_level import TwoRiccati
from lbt_synth.linear.output_feedback.regularised import regularise
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray, require_instance

_RATES = (1.0, 1.37, 0.73, 2.91)  # tried in turn, where a pole is in the way of the map


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiscreteForm:
    """A plant as it was given, and as it is solved."""

    given: GeneralizedPlant
    plant: GeneralizedPlant  # in discrete time; states, u and y scaled by powers of two
    controls: FloatArray  # (m2,) u of a unit of the scaled u
    measurements: FloatArray  # (p2,) scaled y of a unit of y
    rate: float | None  # of the bilinear map [1/s]; None for a plant in discrete time

    def original(self, controller: StateSpace) -> Any:
        """Return a controller in the time and the units of the plant that was given."""
        controller = _in_units(controller, self.measurements, self.controls)
        if self.rate is None:
            return controller
        return ContinuousSystem.from_discrete(controller, self.rate)

    def scaled(self, controller: StateSpace) -> StateSpace:
        """Return a controller of the given plant, in discrete time, in the units of the form."""
        return _in_units(controller, 1 / self.measurements, 1 / self.controls)

    def closed_loop(self, controller: StateSpace) -> tuple[Any, Any, StateSpace]:
        """Return the controller in the time that was given, its loop, and its discrete map."""
        K = self.original(controller)
        loop = self.given.closed_loop(K)
        return K, loop, loop if self.rate is None else loop.to_discrete(self.rate)

    def equations(self, share: float) -> TwoRiccati:
        """Return the equations of the plant, with a share of errors and disturbances added."""
        return TwoRiccati(regularise(self.plant, share) if share else self.plant, self.rate)


def discrete_form(plant: GeneralizedPlant, *, continuous: bool = True) -> DiscreteForm:
    """Return the form in which a plant is solved, if some controller stabilises it.

    Raises a DetectabilityError if none does, and a ProblemError for a plant in continuous time
    where ``continuous`` is False.
    """
    require_instance(plant, GeneralizedPlant, "plant")
    whole = plant.whole
    if isinstance(whole, StateSpace):
        require_stabilisable(plant)
        return _scaled_form(plant, plant.with_whole(whole.balanced()), None)
    if not continuous:
        raise ProblemError(
            "the least variance needs a plant in discrete time; got dt_s=None. Try "
            "control.sample_system, or hinf_controller, whose norm the bilinear map keeps."
        )
    rate = _map_rate(whole)
    mapped = plant.with_whole(whole.to_discrete(rate))
    require_stabilisable(mapped, rate)
    balanced = mapped.with_whole(mapped.whole.balanced())  # type: ignore[union-attr]
    return _scaled_form(plant, balanced, rate)


def _scaled_form(
    given: GeneralizedPlant, plant: GeneralizedPlant, rate: float | None
) -> DiscreteForm:
    """Return the form with controls and measurements of size one, so that no unit is singular."""
    P = plant
    controls, measurements = _units(P.B2, P.D12), _units(P.C2.T, P.D21.T)
    y = measurements[:, None]
    scaled = replace(
        plant,
        B2=P.B2 * controls,
        D12=P.D12 * controls,
        C2=y * P.C2,
        D21=y * P.D21,
        D22=y * P.D22 * controls,
    )
    return DiscreteForm(
        given=given,
        plant=scaled,
        controls=controls,
        measurements=measurements,
        rate=rate,
    )


def _in_units(controller: StateSpace, into: FloatArray, out: FloatArray) -> StateSpace:
    """Return a controller between other units of its inputs (p2,) and outputs (m2,)."""
    K, left = controller, out[:, None]
    return replace(K, B=K.B * into, C=left * K.C, D=left * K.D * into)


def _units(into: FloatArray, through: FloatArray) -> FloatArray:
    """Return powers of two that make columns of two matrices together of size about one."""
    size = np.hypot(np.linalg.norm(into, axis=0), np.linalg.norm(through, axis=0))
    return 1 / nearest_powers_of_two(size)


def _map_rate(system: ContinuousSystem) -> float:
    """Rate of the map that puts the poles about a quarter of the circle: their geometric mean."""
    size = np.abs(system.poles)
    size = size[size > 1e-9 * max(float(size.max()), 1e-300)]
    middle = float(np.exp(np.mean(np.log(size)))) if size.size else 1.0
    away = [np.min(np.abs(system.poles / (middle * factor) - 1)) for factor in _RATES]
    return middle * _RATES[int(np.argmax(np.array(away) > 0.05))]
