"""Discrete algebraic Riccati equations, those of filtering and of H-infinity included."""

from lbt_synth.riccati.dare import Attempt, DareSolution, solve_dare
from lbt_synth.riccati.filtering import FilterRiccati, kalman_riccati, require_detectable
from lbt_synth.riccati.gamma import gamma_riccati, least_gamma
from lbt_synth.riccati.invisible import worst_invisible

__all__ = [
    "Attempt",
    "DareSolution",
    "FilterRiccati",
    "gamma_riccati",
    "kalman_riccati",
    "least_gamma",
    "require_detectable",
    "solve_dare",
    "worst_invisible",
]
