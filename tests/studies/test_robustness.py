"""Robustness to frequency errors."""

from __future__ import annotations

import numpy as np
import pytest
from support.drifting import drifting
from support.plants import lbt_axis_plant

import lbt_synth as lbt


def test_robustness_rows(config):
    rows = list(
        lbt.studies.robustness(
            config.plant, config.truth, config.imaging, errors_hz=[-3, 0, 3], gamma_ratio=1.2
        )
    )
    assert [(r.error_hz, r.method) for r in rows] == [
        (e, m) for e in (-3, 0, 3) for m in ("kalman", "hinf")
    ]
    kalman = {r.error_hz: r for r in rows if r.method == "kalman"}
    assert kalman[0].strehl > max(kalman[-3].strehl, kalman[3].strehl)
    for row in rows:
        parts = row.vibration_nm**2 + row.turbulence_nm**2 + row.noise_nm**2
        assert row.residual_nm**2 == pytest.approx(parts)
    # the same as designing and evaluating by hand
    moved = lbt.kalman(lbt.models.retuned_plant(config.plant, 3, hold="driving"))
    budget = lbt.residual_budget(lbt.close_loop(moved.hardware, moved.controller), config.truth)
    assert kalman[3].residual_nm == pytest.approx(budget.rms_nm, rel=1e-9)


def test_unstable_rows_say_so(config):
    from dataclasses import replace

    truth = replace(config.truth, sensor_gain=0.3)
    (row,) = lbt.studies.robustness(
        config.plant, truth, config.imaging, errors_hz=[0], methods=["hinf"], gamma_ratio=1.05
    )
    assert not row.stable
    assert np.isnan(row.strehl)


def test_the_study_refuses_what_it_cannot_do(config):
    turbulence = config.plant.turbulence[0]
    still = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=turbulence, noise_nm=10)
    with pytest.raises(lbt.errors.ProblemError, match="needs a vibration in the model"):
        list(lbt.studies.robustness(still, config.truth, config.imaging, errors_hz=[0]))
    with pytest.raises(lbt.errors.ProblemError, match="method must be one of"):
        list(
            lbt.studies.robustness(
                config.plant, config.truth, config.imaging, errors_hz=[0], methods=["magic"]
            )
        )
    with pytest.raises(lbt.errors.ProblemError, match="above 0"):
        list(lbt.studies.robustness(config.plant, config.truth, config.imaging, errors_hz=[-25]))


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
