"""Specifications of a closed loop that are convex in the Youla parameter."""

from lbt_synth.shaping.bounds import Attenuation, CommandRms, ModulusMargin, NoisePeak
from lbt_synth.shaping.demands import Demand
from lbt_synth.shaping.specification import Specification
from lbt_synth.shaping.terms import ResidualVariance, Term, Total, VibrationBand, Worst
from lbt_synth.shaping.uncertainty import DelayError, MirrorUncertainty, SensorGainRange

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
