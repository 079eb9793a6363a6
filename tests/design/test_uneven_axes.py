"""Designs for axes with different turbulence and noise."""

from __future__ import annotations

import numpy as np
import pytest
from support.uneven_axes import LOOPS, QUICK, RATE, SLOW

import lbt_synth as lbt
from lbt_synth.loop.least_residuals.residual_limit import least_model_residual


def test_the_plant_of_uneven_axes_is_two_plants():
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=RATE, turbulence=[SLOW, QUICK], noise_nm=[15.5, 6.0], sensor_gain=[0.9, 0.7]
    )
    np.testing.assert_array_equal(plant.hardware.sensor, np.diag([0.9, 0.7]))
    np.testing.assert_allclose(plant.R, np.diag([15.5, 6.0]) ** 2, rtol=1e-14)
    both = lbt.kalman(plant)
    alone = [
        lbt.kalman(
            lbt.tip_tilt_plant(
                frame_rate_hz=RATE, turbulence=model, noise_nm=noise, sensor_gain=gain, modes=1
            )
        ).rms
        for model, noise, gain in ((SLOW, 15.5, 0.9), (QUICK, 6.0, 0.7))
    ]
    assert both.rms == pytest.approx(np.hypot(*alone), rel=1e-9)
    limit = least_model_residual(plant)
    np.testing.assert_allclose(np.sqrt(limit.variance_nm2), alone, rtol=1e-6)


def test_truths_of_other_loops_are_refused():
    both, single = LOOPS
    two = lbt.Truth(turbulence=[SLOW, QUICK], noise_nm=5.0)
    noisy = lbt.Truth(turbulence=SLOW, noise_nm=[5.0, 5.0])
    design = lbt.integrator(single, gain=0.4)
    loop = lbt.close_loop(single, design.controller)
    for act in (
        lambda truth: lbt.residual_budget(loop, truth),
        lambda truth: lbt.loop.least_residual(single, truth),
        lambda truth: lbt.simulate(design.controller, truth, hardware=single, frames=9, seed=0),
        lambda truth: lbt.design.optimal_integrator(single, truth),
    ):
        with pytest.raises(lbt.errors.DimensionError, match=r"one a mode \(1\); got 2"):
            act(two)
        with pytest.raises(lbt.errors.DimensionError, match=r"one a measurement \(1\); got 2"):
            act(noisy)
    for wrong in ({"noise_nm": [1.0]}, {"noise_nm": 1.0, "sensor_gain": [1.0]}):
        with pytest.raises(lbt.errors.DimensionError, match="measurement"):
            lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=SLOW, **wrong)
    with pytest.raises(lbt.errors.ProblemError, match="the truth must disturb the loop"):
        lbt.design.optimal_integrator(both, lbt.Truth(turbulence=[None, None], noise_nm=[0, 0]))
