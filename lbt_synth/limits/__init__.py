"""Limits of performance: what no linear controller can beat, by spectral factorisation.

Nothing here knows of designs, Riccati equations or loops: it is a second opinion on them.
"""

from lbt_synth.limits.band import BandLimit, least_worst_residual
from lbt_synth.limits.residual import ResidualLimit, least_model_residual, least_residual

__all__ = [
    "BandLimit",
    "ResidualLimit",
    "least_model_residual",
    "least_residual",
    "least_worst_residual",
]
