"""The least level of gamma that a controller reaches, between a controller and a proof."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from lbt_synth.errors import NonFiniteError, NumericalError
from lbt_synth.linear.generalized_plant import GeneralizedPlant
from lbt_synth.linear.matrix_functions import semidefinite_root
from lbt_synth.linear.norms import hinf_norm
from lbt_synth.linear.output_feedback.central_controller import central_controller
from lbt_synth.linear.output_feedback.full_information import (
    FullInformation,
    WorstCase,
    control_side,
    estimation_side,
)
from lbt_synth.linear.output_feedback.lower_bound import (
    ControlWitness,
    coupled_bursts,
    last_step,
    steady_oscillation,
)
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray

_TOLERANCE = 1e-11
_NOTHING = 1e-6  # part of the level of the least variance that counts as none
_SLOW = 0.99  # a pole of the worst case beyond this may belong to a steady oscillation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelSolution:
    """Solutions of both sides at a level."""

    gamma: float
    X: FloatArray
    Y: FloatArray


class TwoRiccati:
    """The two equations of a plant, at any level."""

    def __init__(self, plant: GeneralizedPlant) -> None:
        self.plant = plant
        self.control = FullInformation(control_side(plant))
        self.estimation = FullInformation(estimation_side(plant))

    def least_variance(self) -> StateSpace:
        """Return the controller of least variance."""
        return central_controller(self.plant, self.control.least, self.estimation.least)

    def controller(self, solution: LevelSolution) -> StateSpace:
        """Return the central controller of a solution."""
        X = self.control.refine(solution.X, solution.gamma)
        Y = self.estimation.refine(solution.Y, solution.gamma)
        return central_controller(self.plant, X, Y, solution.gamma)

    def solve(self, gamma: float) -> tuple[float, LevelSolution | None]:
        """Return the least slack of the three conditions, and the solutions where it is above 0."""
        try:
            slack, X = self.control.solve(gamma)
            other, Y = (-1.0, None) if X is None else self.estimation.solve(gamma)
            if X is None or Y is None:
                return -1.0, None
            root = semidefinite_root(X)
            coupling = 1 - float(np.linalg.eigvalsh(root.T @ Y @ root)[-1]) / gamma**2
        except np.linalg.LinAlgError:  # singular to working accuracy, as next to a level of zero
            return -1.0, None
        least = min(slack, other, coupling)
        return least, LevelSolution(gamma=gamma, X=X, Y=Y) if least > 0 else None

    def least_level(self) -> LevelSolution:
        """Return the solution at the least level, to a relative 1e-11.

        Raises a NumericalError if not even the level of the least variance has one.
        """
        found: dict[float, LevelSolution] = {}

        def slack(gamma: float) -> float:
            value, solution = self.solve(gamma)
            if solution is None:
                return min(value, -_TOLERANCE)  # at a slack of 0 there is no controller
            found[gamma] = solution
            return value

        loop = self.plant.closed_loop(self.least_variance())
        upper = hinf_norm(loop).upper if loop.spectral_radius < 1 else np.inf
        floors = self.control.floor(), self.estimation.floor()
        lower = max(*floors, _NOTHING * upper) * (1 - 1e-12) if np.isfinite(upper) else 0.0
        for growth in np.geomspace(1e-9, 1e9, 19):  # next to nothing rounding is larger
            if not np.isfinite(upper) or slack(upper * (1 + growth)) > 0:
                break
        if not found:
            raise NumericalError(
                "the Riccati equations have no solution at the level of the least variance. "
                "Scale states and signals to similar sizes.",
                status="search",
            )
        upper = min(found)
        if lower < upper and slack(lower) <= 0:
            brentq(slack, lower, upper, xtol=2 * _TOLERANCE * upper)  # its steps are half of it
        return found[min(found)]

    def _frequency_text(self, angle: float) -> str:
        """Return the frequency of an angle on the unit circle."""
        return f"{angle / (2 * np.pi * self.plant.dt_s):.6g} Hz"

    def proofs(self, solution: LevelSolution, plant: GeneralizedPlant) -> list[ControlWitness]:
        """Return what may prove of a plant, this or the one next to it, that no level is lower.

        Bursts belong to this plant alone. Steady oscillations have frequency zero, the highest one,
        and those of the slow poles of the worst cases. At levels next to zero there may be none.
        """
        out: list[ControlWitness] = []
        with suppress(np.linalg.LinAlgError):
            control = self.control.worst_case(solution.X, solution.gamma)
            estimation = self.estimation.worst_case(solution.Y, solution.gamma)
            if plant is self.plant:
                with suppress(NonFiniteError):  # of a worst case that rounding makes unstable
                    unmoved = last_step(control, solution.X)
                    out.append(ControlWitness(unseen=None, unmoved=unmoved, reason=_CONTROL))
                with suppress(NonFiniteError):
                    unseen = last_step(estimation, solution.Y)
                    out.append(ControlWitness(unseen=unseen, unmoved=None, reason=_ESTIMATION))
                with suppress(NonFiniteError):
                    unseen, unmoved = coupled_bursts(control, solution.X, estimation, solution.Y)
                    out.append(ControlWitness(unseen=unseen, unmoved=unmoved, reason=_COUPLED))
            for angle in _slow_angles(control):
                pairs = steady_oscillation(control_side(plant), angle)
                words = f"{_CONTROL_AT} {self._frequency_text(angle)}"
                out.append(ControlWitness(unseen=None, unmoved=pairs, reason=words))
            for angle in _slow_angles(estimation):
                pairs = steady_oscillation(estimation_side(plant), angle)
                words = f"{_ESTIMATION_AT} {self._frequency_text(angle)}"
                out.append(ControlWitness(unseen=pairs, unmoved=None, reason=words))
        return out


def _slow_angles(worst: WorstCase) -> list[float]:
    """Angles of the slow poles of a worst case, the slowest few, and both ends."""
    poles = np.linalg.eigvals(worst.A)
    slow = poles[(np.abs(poles) > _SLOW) & (poles.imag >= 0)]
    return [*(float(np.angle(pole)) for pole in slow[np.argsort(-np.abs(slow))][:4]), 0.0, np.pi]


_COUPLED = "what is not seen in time cannot be made good in time"
_CONTROL = "even a controller that knows the state and the disturbance leaves as much"
_ESTIMATION = "even a control that reaches every state leaves as much, as the disturbance is unseen"
_CONTROL_AT = "even a controller that knows the disturbance leaves as much at"
_ESTIMATION_AT = "even a control that reaches every state leaves as much, unseen, at"
