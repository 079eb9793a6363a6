"""The parts that a plant is assembled from, in one value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.ar_model import ARModel
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.sensor_suite import Motions, checked_motions
from lbt_synth.models.vibration import Vibration, checked_direction
from lbt_synth.validation import FloatArray, set_fields


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlantParts:
    """Loop, turbulence, vibrations and noise, which fit each other."""

    hardware: LoopHardware  # with the sensor gain that the design assumes in its sensor matrix
    turbulence: tuple[ARModel, ...]  # one per mode
    vibrations: tuple[Vibration, ...]
    noise_factor: FloatArray  # (q, q): square root of the noise covariance of the loop's own sensor
    motions: Motions = ()  # of the channels that each vibration moves; of none by default

    def __post_init__(self) -> None:
        n, rate = self.hardware.modes, self.hardware.frame_rate_hz
        if len(self.turbulence) != n:
            raise DimensionError(
                f"turbulence must be one ARModel, or one per mode ({n}); got "
                f"{len(self.turbulence)}."
            )
        for model in self.turbulence:
            if not np.isclose(model.frame_rate_hz, rate, rtol=1e-9):
                raise ProblemError(
                    f"the turbulence model must be sampled at the frame rate {rate:.6g} Hz; got "
                    f"{model.frame_rate_hz:.6g} Hz."
                )
        for line in self.vibrations:
            checked_direction(line, self.hardware)
        lines = len(self.vibrations)
        motions = self.motions if any(self.motions) else ({},) * lines
        set_fields(self, motions=checked_motions(motions, self.hardware.suite, lines))
        for line, motion in zip(self.vibrations, self.motions, strict=True):
            if line.sections > 1 and motion:
                raise ProblemError(
                    f"a bump of {line.sections} sections moves no channel of an accelerometer; got "
                    f"the motion of {', '.join(motion)} with that at {line.frequency_hz:.6g} Hz. "
                    "Try sections=1, or leave the motion out."
                )

    @property
    def order(self) -> int:
        """Largest order of a turbulence model."""
        return max(model.order for model in self.turbulence)

    @property
    def sections(self) -> int:
        """Number of resonances, those of a bump each counted."""
        return sum(line.sections for line in self.vibrations)

    @property
    def size(self) -> int:
        """Number of states of the plant of the loop's own sensor."""
        blocks = self.order + held_frames(self.hardware)
        return 2 * self.sections + blocks * self.hardware.modes


def held_frames(hardware: LoopHardware) -> int:
    """Return how many frames of the total phase the state of a plant holds."""
    return max(int(np.ceil(hardware.delay_frames)), 2) - 1
