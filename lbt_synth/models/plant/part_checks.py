"""Check the parts that a plant is assembled from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models.ar_model import ARModel
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.vibration.resonance import Vibration
from lbt_synth.validation import FloatArray, definite, frozen_copy, number, real_array


def checked_turbulence(
    turbulence: ARModel | Sequence[ARModel], hardware: LoopHardware
) -> tuple[ARModel, ...]:
    """Return one turbulence model per mode."""
    n = hardware.modes
    models = (turbulence,) * n if isinstance(turbulence, ARModel) else tuple(turbulence)
    if len(models) != n:
        raise DimensionError(
            f"turbulence must be one ARModel, or one per mode ({n}); got {len(models)}."
        )
    for model in models:
        if not np.isclose(model.frame_rate_hz, hardware.frame_rate_hz, rtol=1e-9):
            raise ProblemError(
                f"the turbulence model must be sampled at the frame rate "
                f"{hardware.frame_rate_hz:.6g} Hz; got {model.frame_rate_hz:.6g} Hz."
            )
    return models


def checked_vibrations(
    vibrations: Sequence[Vibration] | None, hardware: LoopHardware
) -> tuple[Vibration, ...]:
    """Return the vibrations, whose directions must fit the modes."""
    if vibrations is None:
        return ()
    lines = tuple(vibrations)
    if not lines:
        raise ProblemError(
            "vibrations is empty; expected at least one Vibration, or None (leave it out) "
            "for a plant without vibrations."
        )
    for line in lines:
        if len(line.direction) != hardware.modes:
            raise DimensionError(
                f"the direction of a vibration must have {hardware.modes} components, one per "
                f"mode; got {len(line.direction)} at {line.frequency_hz:.6g} Hz."
            )
    return lines


def noise_factor(noise_nm: Any, q: int) -> FloatArray:
    """Return the square root of the noise covariance, (q, q)."""
    if np.ndim(noise_nm) == 0:
        return frozen_copy(number(noise_nm, "noise_nm", above=0) * np.eye(q))
    if np.ndim(noise_nm) == 1:
        deviations = real_array(noise_nm, "noise_nm")
        if deviations.size != q:
            raise DimensionError(
                f"noise_nm must have one deviation per measurement ({q}); got {deviations.size}."
            )
        return frozen_copy(np.diag([number(value, "noise_nm", above=0) for value in deviations]))
    covariance = definite(noise_nm, "noise_nm", size=(q, "to match the measurements"))
    return frozen_copy(np.linalg.cholesky(covariance))


def measurement_gains(sensor_gain: Any, q: int) -> FloatArray:
    """Return the sensor gain of each measurement, (q,)."""
    if np.ndim(sensor_gain) == 0:
        return frozen_copy(np.full(q, number(sensor_gain, "sensor_gain", above=0)))
    gains = real_array(sensor_gain, "sensor_gain")
    if gains.shape != (q,):
        raise DimensionError(
            f"sensor_gain must be one number, or one per measurement ({q}); got shape "
            f"{gains.shape}."
        )
    for gain in gains:
        number(gain, "sensor_gain", above=0)
    return gains
