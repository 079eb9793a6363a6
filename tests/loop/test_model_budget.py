"""The residual that a plant's own model gives, against that of its truth."""

from __future__ import annotations

import numpy as np
import pytest
from support.predictions import (
    CASES,
    RATE,
    SHELL,
    SLOW,
    a_plant,
    a_truth,
)

import lbt_synth as lbt


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), CASES)
def test_the_budget_of_a_model_is_that_of_its_truth(delay, gain, mirror, sensor):
    plant = a_plant(delay=delay, gain=gain, mirror=mirror, sensor=sensor)
    controller = lbt.integrator(plant.hardware, gain=0.2).controller
    loop = lbt.close_loop(plant.hardware, controller)
    own, other = lbt.loop.model_budget(loop, plant), lbt.residual_budget(loop, a_truth())
    for name in ("turbulence_nm2", "noise_nm2", "random_vibration_nm2", "total_nm2"):
        np.testing.assert_allclose(getattr(own, name), getattr(other, name), rtol=1e-9, atol=1e-9)
    bare = a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    again = lbt.loop.model_budget(lbt.close_loop(bare, controller, sensor_gain=gain), plant)
    np.testing.assert_allclose(again.total_nm2, own.total_nm2, rtol=1e-9, atol=1e-9)


def test_noise_that_is_correlated_between_axes():
    noise = np.array([[200.0, 60.0], [60.0, 100.0]])
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, noise_nm=noise)
    design = lbt.kalman(plant)
    budget = lbt.loop.model_budget(lbt.close_loop(plant.hardware, design.controller), plant)
    assert budget.rms_nm == pytest.approx(design.rms, rel=1e-9)


def test_a_budget_of_another_loop_is_refused():
    plant = a_plant()
    for other in (a_plant(delay=3.0), a_plant(gain=0.5), a_plant(mirror=SHELL)):
        loop = lbt.close_loop(other.hardware, lbt.integrator(other.hardware, gain=0.1).controller)
        with pytest.raises(
            lbt.errors.ProblemError, match="plant's sensor, mirror and delay; got another"
        ):
            lbt.loop.model_budget(loop, plant)
    unstable = lbt.close_loop(
        plant.hardware, lbt.integrator(plant.hardware, gain=0.9).controller, sensor_gain=1.0
    )
    wild = lbt.Controller(
        A=np.eye(2), B=3 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / RATE
    )
    assert unstable.is_stable
    with pytest.raises(lbt.errors.UnstableLoopError):
        lbt.loop.model_budget(lbt.close_loop(plant.hardware, wild), plant)
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.loop.model_budget(unstable, a_truth())
    with pytest.raises(lbt.errors.ProblemError, match="expected a ClosedLoop"):
        lbt.loop.model_budget(unstable.system, plant)
    with pytest.raises(lbt.errors.ProblemError, match="expected a TipTiltPlant"):
        lbt.design.model_integrator(a_truth())
