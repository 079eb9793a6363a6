"""Levels of the norm of several sensors: the bound of a design, the least one, and its filter."""

from __future__ import annotations

from dataclasses import dataclass

from lbt_synth.design.hinf import checked_bounds, require_reachable
from lbt_synth.errors import InfeasibleError
from lbt_synth.linear import hinf_norm
from lbt_synth.linear.periodic.riccati import (
    PeriodicRiccati,
    least_periodic_gamma,
    periodic_hinf,
    periodic_kalman,
    proved_periodic_gamma,
)
from lbt_synth.models.fusion.plant import FusedPlant
from lbt_synth.validation import require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Level:
    """A bound of the norm, beside the least one, one that no filter meets, and the Kalman's."""

    bound: float
    least: float
    infeasible: float | None  # that no filter reaches; None where nothing is proved
    start: PeriodicRiccati  # the Kalman filter
    kalman: float  # its norm

    @property
    def claims(self) -> dict[str, float | None]:
        """What a design of the level says of its norm."""
        return {
            "gamma_requested": self.bound,
            "gamma_least": self.least,
            "gamma_infeasible": self.infeasible,
        }


def find_level(plant: FusedPlant, gamma: float | None, gamma_ratio: float | None) -> Level:
    """Find the least gamma, and check the bound that is given, or make it: 1.2 times the least."""
    require_instance(plant, FusedPlant, "plant")
    gamma, gamma_ratio = checked_bounds(
        gamma, gamma_ratio, far_above="the filter is the Kalman filter"
    )
    start = periodic_kalman(plant)
    norm = error_norm(plant, start)
    least = least_periodic_gamma(plant, start, norm)
    requested = gamma if gamma is not None else least * (gamma_ratio or 1.2)
    require_reachable(requested, least)
    return Level(
        bound=max(requested, least),
        least=least,
        infeasible=proved_periodic_gamma(plant, start, least) or None,
        start=start,
        kalman=norm,
    )


def error_norm(plant: FusedPlant, solution: PeriodicRiccati) -> float:
    """Return the norm of a filter's estimation error over a period."""
    return hinf_norm(plant.error_system(solution.gains).lifted_compactly()).upper


def central_filter(plant: FusedPlant, gamma: float, start: PeriodicRiccati) -> PeriodicRiccati:
    """Return the central filter of a level; InfeasibleError if there is none."""
    found = periodic_hinf(plant, gamma, start)
    if found is None:
        raise InfeasibleError(
            f"the gamma-Riccati equation has no stabilising solution at gamma = {gamma:.9g}. "
            "Try a larger gamma.",
            gamma=gamma,
        )
    return found
