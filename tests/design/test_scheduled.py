"""Filters that follow the sensor gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.models.plant.tip_tilt import assemble

GRID = (0.35, 0.5, 0.8)


@pytest.fixture(scope="module")
def schedule():
    return lbt.design.scheduled_filter(lbt_axis_plant(), gains=GRID, gain_error=0.3)


def test_at_a_gain_of_the_grid_it_is_the_filter_of_that_gain(schedule):
    plant = lbt_axis_plant()
    half = replace(plant.hardware, sensor_matrix=0.5 * plant.hardware.sensor)
    own = lbt.kalman(assemble(replace(plant.parts(), hardware=half))).controller
    found = schedule.controller_at(0.5)
    f = np.linspace(0.5, 400, 50)
    np.testing.assert_allclose(
        found.to_statespace().frequency_response(f),
        own.to_statespace().frequency_response(f),
        rtol=1e-9,
    )


def test_between_and_beyond_the_grid(schedule):
    middle, ends = schedule.form_at(0.65), (schedule.form_at(0.5), schedule.form_at(0.8))
    np.testing.assert_allclose(middle.A, (ends[0].A + ends[1].A) / 2, atol=1e-15)
    np.testing.assert_allclose(0.65 * middle.B, (0.5 * ends[0].B + 0.8 * ends[1].B) / 2)
    assert np.array_equal(schedule.form_at(3.0).B, schedule.form_at(0.8).B)


def test_the_loop_stays_stable_where_the_fixed_filter_does_not(schedule):
    plant = lbt_axis_plant()
    assert schedule.certificate.passed
    rng = np.random.default_rng(5)
    known = 0.35 + 0.45 * np.abs(np.sin(np.arange(3000) * 1e-3 / 0.45))  # 0.8 per second
    real = known * (1 + 0.3 * rng.choice([-1, 1], 3000))  # at any speed
    calm = lbt.Truth(turbulence=plant.turbulence[0], noise_nm=15.5)
    settings = {"hardware": plant.hardware, "frames": 3000, "settle_frames": 0}
    run = lbt.simulate(schedule.start(known), calm, sensor_gains=real, **settings)
    assert np.max(np.abs(run.residual_nm)) < 2000
    fixed = schedule.controller_at(0.35)
    assert lbt.loop.stable_sensor_gains(plant.hardware, fixed, nominal=0.35)[1] < 0.8
    wild = lbt.simulate(fixed, calm, sensor_gains=np.full(3000, 0.8), **settings)
    assert np.max(np.abs(wild.residual_nm)) > 1e6


def test_a_running_filter_of_a_constant_gain_is_the_controller(schedule):
    running, fixed = schedule.start(0.6), schedule.controller_at(0.6).start()
    series = np.random.default_rng(6).standard_normal((50, 1))
    for _ in range(2):
        found = [running.step(y)[0] for y in series]
        np.testing.assert_allclose(found, [fixed.step(y)[0] for y in series], rtol=1e-6, atol=1e-9)
        running.reset()
        fixed.reset()


def test_what_cannot_be_proved_is_refused_with_what_can():
    plant = lbt_axis_plant()
    with pytest.raises(lbt.errors.CertificateError, match="proved nothing"):
        lbt.design.scheduled_filter(plant, gains=GRID, gain_error=0.99)


@pytest.mark.parametrize("gains", [[0.5], [0.8, 0.5], [[0.5, 0.8]], [0.0, 1.0]])
def test_wrong_grids_are_refused(gains):
    with pytest.raises(lbt.errors.ProblemError, match="gains must be"):
        lbt.design.scheduled_filter(lbt_axis_plant(), gains=gains)


def test_filters_whose_states_differ_are_refused():
    def design(plant):
        return lbt.kalman(plant, horizon=1 if plant.C[0, -1] > 0.4 else 3)

    with pytest.raises(lbt.errors.LbtSynthError):
        lbt.design.scheduled_filter(lbt_axis_plant(), gains=GRID, design=design)
