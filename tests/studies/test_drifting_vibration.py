"""Whatever needs a stationary truth refuses a drifting vibration."""

from __future__ import annotations

import pytest
from support.drifting import drifting
from support.plants import lbt_axis_plant

import lbt_synth as lbt


def test_what_needs_a_stationary_truth_refuses_it(config):
    plant = lbt_axis_plant()
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=(drifting(),), noise_nm=15.5)
    design = lbt.kalman(plant)
    loop = lbt.close_loop(plant.hardware, design.controller)
    camera = lbt.Imaging(diameter_m=8.22)
    hw = plant.hardware
    for refused in (
        lambda: lbt.residual_budget(loop, truth),
        lambda: lbt.loop.least_residual(hw, truth),
        lambda: lbt.loop.least_worst_residual(
            hw, truth, band_hz=(15, 25), rms_nm=100, direction=(1,)
        ),
        lambda: lbt.studies.robustness_map(design, truth, camera, errors_hz=[0], sensor_gains=[1]),
        lambda: lbt.studies.limits({"kalman": design}, hw, truth, camera),
        lambda: list(lbt.studies.robustness(plant, truth, camera, errors_hz=[0])),
        lambda: lbt.design.optimal_integrator(hw, truth),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="drifts from 17 to 23 Hz. Simulate it"):
            refused()
