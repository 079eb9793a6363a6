"""The kinds of demands on a shaped loop."""

from __future__ import annotations

from typing import TypeAlias

from lbt_synth.design.shaping.bounds import Attenuation, CommandRms, ModulusMargin, NoisePeak
from lbt_synth.design.shaping.uncertainty import DelayError, MirrorUncertainty, SensorGainRange

Demand: TypeAlias = (
    ModulusMargin
    | NoisePeak
    | Attenuation
    | SensorGainRange
    | DelayError
    | MirrorUncertainty
    | CommandRms
)
DEMANDS = (
    ModulusMargin,
    NoisePeak,
    Attenuation,
    SensorGainRange,
    DelayError,
    MirrorUncertainty,
    CommandRms,
)
