"""Vibrations in a loop: whether they fit its modes and its frame rate, and whether they drift."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.vibration.drifting import DriftingVibration
from lbt_synth.models.vibration.resonance import Vibration, require_below_nyquist
from lbt_synth.models.vibration.sinusoid import SinusoidalVibration
from lbt_synth.validation import FloatArray

TrueVibration: TypeAlias = Vibration | SinusoidalVibration | DriftingVibration


def checked_direction(vibration: TrueVibration, hardware: LoopHardware) -> FloatArray:
    """Return the direction (n,) of a vibration, which must fit the loop."""
    if isinstance(vibration, DriftingVibration):
        frequency_hz = vibration.highest_hz
    else:
        frequency_hz = vibration.frequency_hz
    if len(vibration.direction) != hardware.modes:
        raise DimensionError(
            f"the direction of a vibration must have {hardware.modes} components, one per mode; "
            f"got {len(vibration.direction)} at {frequency_hz:.6g} Hz."
        )
    require_below_nyquist(frequency_hz, hardware.frame_rate_hz)
    return np.array(vibration.direction)


def stationary_vibrations(
    vibrations: Iterable[TrueVibration],
) -> tuple[Vibration | SinusoidalVibration, ...]:
    """Return the vibrations; refuse one that drifts."""
    still = []
    for vibration in vibrations:
        if isinstance(vibration, DriftingVibration):
            raise ProblemError(
                "this needs a truth that is stationary; got a vibration that drifts from "
                f"{vibration.start_hz:.6g} to {vibration.end_hz:.6g} Hz. Simulate it, or take "
                "vibrations that stay, at the frequencies in question."
            )
        still.append(vibration)
    return tuple(still)
