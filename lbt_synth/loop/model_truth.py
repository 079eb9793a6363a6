"""Residual of a closed loop where a plant's own model is the truth."""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.loop.budget import ResidualBudget, ar_covariance
from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.loop_hardware import same_mirror
from lbt_synth.models.truth import fitted_direction
from lbt_synth.validation import frozen, instance


def model_budget(loop: ClosedLoop, plant: TipTiltPlant) -> ResidualBudget:
    """Exact stationary residual of a loop where a plant's model is the truth.

    Each mode has its own turbulence and each measurement its own noise, as in the plant.

    Parameters
    ----------
    loop : ClosedLoop
        A loop of the plant's hardware, around any controller.
    plant : TipTiltPlant
        Turbulence, vibrations and noise.

    Returns
    -------
    ResidualBudget
        Covariances by origin.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable or marginally stable.
    ProblemError
        If the loop has another sensor, mirror or delay than the plant.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=15.5)
    >>> design = lbt.kalman(plant)
    >>> loop = lbt.close_loop(plant.hardware, design.controller)
    >>> bool(abs(lbt.loop.model_budget(loop, plant).rms_nm / design.rms - 1) < 1e-9)
    True
    """
    instance(plant, TipTiltPlant)
    instance(loop, ClosedLoop)
    one, other = loop.hardware, plant.hardware
    seen = loop.sensor_gain * one.sensor
    alike = (
        seen.shape == other.sensor.shape
        and one.influence.shape == other.influence.shape
        and np.allclose(seen, other.sensor, rtol=1e-9, atol=0)
        and np.allclose(one.influence, other.influence, rtol=1e-9, atol=0)
        and one.delay_frames == other.delay_frames
        and same_mirror(one, other)
    )
    if not alike:
        raise ProblemError(
            "the loop must have the plant's sensor, mirror and delay; got another. Close it with "
            "close_loop(plant.hardware, controller)."
        )
    loop.require_stable()
    n, s = one.modes, loop.system
    each = np.eye(n)
    turbulence, vibration = np.zeros((2, n, n))
    for model, direction in zip(plant.turbulence, each, strict=True):
        turbulence += ar_covariance(loop, model, direction[None])
    for line in plant.vibrations:
        direction = fitted_direction(line, one)
        vibration += ar_covariance(loop, line.ar_model(one.frame_rate_hz), direction[None])
    entry, through = s.B[:, n:], s.D[:n, n:]
    states = stationary_covariance(s.A, entry @ plant.R @ entry.T)
    noise = s.C[:n] @ states @ s.C[:n].T + through @ plant.R @ through.T
    return ResidualBudget(
        turbulence_nm2=frozen(turbulence),
        noise_nm2=frozen(noise),
        random_vibration_nm2=frozen(vibration),
        line_amplitudes_nm=np.zeros((0, n), dtype=np.complex128),
    )
