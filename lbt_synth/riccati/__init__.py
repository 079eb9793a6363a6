"""Discrete algebraic Riccati equations, those of filtering and of H-infinity included."""

from lbt_synth.riccati.dare import DareSolution, solve_dare
from lbt_synth.riccati.filtering import (
    FilterRiccati,
    gamma_riccati,
    kalman_riccati,
    least_gamma,
    require_detectable,
)

__all__ = [
    "DareSolution",
    "FilterRiccati",
    "gamma_riccati",
    "kalman_riccati",
    "least_gamma",
    "require_detectable",
    "solve_dare",
]
