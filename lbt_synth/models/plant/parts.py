"""The parts that a plant is assembled from, in one value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.ar_model import ARModel
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.vibration import Vibration, checked_direction
from lbt_synth.validation import FloatArray, definite, frozen_copy, one_or_each


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlantParts:
    """Loop, turbulence, vibrations and noise, which fit each other."""

    hardware: LoopHardware  # with the sensor gain that the design assumes in its sensor matrix
    turbulence: tuple[ARModel, ...]  # one per mode
    vibrations: tuple[Vibration, ...]
    noise_factor: FloatArray  # (q, q): square root of the noise covariance

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

    @property
    def order(self) -> int:
        """Largest order of a turbulence model."""
        return max(model.order for model in self.turbulence)

    @property
    def size(self) -> int:
        """Number of states of the plant."""
        blocks = self.order + held_frames(self.hardware)
        return 2 * len(self.vibrations) + blocks * self.hardware.modes


def held_frames(hardware: LoopHardware) -> int:
    """Return how many frames of the total phase the state of a plant holds."""
    return max(int(np.ceil(hardware.delay_frames)), 2) - 1


def noise_factor(noise_nm: Any, q: int) -> FloatArray:
    """Return the square root (q, q) of the noise covariance, from deviations or the covariance."""
    if np.ndim(noise_nm) < 2:
        deviations = one_or_each(noise_nm, "noise_nm", q, above=0)
        return frozen_copy(np.diag(np.broadcast_to(deviations, q)))
    covariance = definite(noise_nm, "noise_nm", size=(q, "to match the measurements"))
    return frozen_copy(np.linalg.cholesky(covariance))
