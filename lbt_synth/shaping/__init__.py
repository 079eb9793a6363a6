"""Specifications of a closed loop that are convex in the Youla parameter."""

from lbt_synth.shaping.demands import (
    Attenuation,
    CommandRms,
    DelayError,
    Demand,
    MirrorUncertainty,
    ModulusMargin,
    NoisePeak,
    SensorGainRange,
)
from lbt_synth.shaping.specification import Specification
from lbt_synth.shaping.terms import ResidualVariance, Term, Total, VibrationBand, Worst

__all__ = [
    "Attenuation",
    "CommandRms",
    "DelayError",
    "Demand",
    "MirrorUncertainty",
    "ModulusMargin",
    "NoisePeak",
    "ResidualVariance",
    "SensorGainRange",
    "Specification",
    "Term",
    "Total",
    "VibrationBand",
    "Worst",
]
