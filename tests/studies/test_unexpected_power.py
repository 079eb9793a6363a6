"""Power that a design was not made for, against the exact residual of each part."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt

RATE = 800
AIR = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=RATE)
PLANT = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=AIR, noise_nm=5.0)
SHAKE = lbt.Vibration(frequency_hz=30, damping=0.01, rms_nm=100, direction=(0, 1))


def found(design, truth):
    loop = lbt.close_loop(PLANT.hardware, design.controller, sensor_gain=truth.sensor_gain)
    return lbt.studies.unexpected_power(design, loop, truth), loop


def truth_with(*lines, **changes):
    return replace(lbt.Truth(turbulence=AIR, vibrations=lines, noise_nm=5.0), **changes)


def test_the_truth_of_the_model_has_nothing_unexpected():
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE, turbulence=AIR, vibrations=[SHAKE], noise_nm=5.0)
    assert found(lbt.kalman(plant), truth_with(SHAKE))[0] == ()


def test_a_sinusoid_leaves_what_the_sensitivity_says():
    sine = lbt.models.SinusoidalVibration(frequency_hz=41, rms_nm=80, direction=(0, 1))
    (row,), loop = found(lbt.kalman(PLANT), truth_with(sine))
    assert (row.what, row.mode, row.low_hz, row.high_hz) == ("a vibration", 2, 41, 41)
    assert row.left_nm == pytest.approx(80 * abs(loop.sensitivity([41])[0, 1, 1]))
    assert row.true_nm == pytest.approx(80)
    assert row.expected_nm < 5
    assert str(row).startswith("the truth has a vibration at 41 Hz on axis 2, 80 nm")


def test_a_random_vibration_leaves_what_the_budget_says():
    (row,), loop = found(lbt.kalman(PLANT), truth_with(SHAKE))
    exact = lbt.residual_budget(loop, truth_with(SHAKE)).vibration_nm
    assert (row.mode, row.low_hz) == (2, 30)
    assert row.left_nm == pytest.approx(exact, rel=0.02)  # but for its farthest skirts
    assert row.true_nm == pytest.approx(100, rel=0.02)


def test_turbulence_beyond_the_model_is_a_band():
    hum = lbt.models.TabulatedSpectrum(
        frequency_hz=[60, 61, 69, 70], density_nm2_hz=[0, 500, 500, 0]
    )
    air = lbt.models.SumSpectrum(parts=[AIR, hum])
    rows, loop = found(lbt.kalman(PLANT), truth_with(turbulence=air))
    assert sorted((row.what, row.mode) for row in rows) == [("turbulence", 1), ("turbulence", 2)]
    assert 58 < rows[0].low_hz < 62
    assert 68 < rows[0].high_hz < 72
    more = [
        lbt.residual_budget(loop, truth_with(turbulence=each)).turbulence_nm for each in (air, AIR)
    ]
    assert rows[0].left_nm == pytest.approx(np.sqrt((more[0] ** 2 - more[1] ** 2) / 2), rel=0.05)


@pytest.fixture(scope="module")
def banded():
    band = lbt.design.shaping.VibrationBand(low_hz=18, high_hz=22, rms_nm=150)
    return lbt.robust(PLANT, bands=[band], functions=16, states=None)


@pytest.mark.parametrize(
    ("frequency_hz", "rms_nm", "expected"),
    [(18.0, 150, True), (20.0, 200, True), (22.0, 150, True), (20.0, 400, False), (60, 150, False)],
)
def test_a_band_expects_a_vibration_of_its_size_anywhere_in_it(
    banded, frequency_hz, rms_nm, expected
):
    sine = lbt.models.SinusoidalVibration(
        frequency_hz=frequency_hz, rms_nm=rms_nm, direction=(1, 0)
    )
    rows = found(banded, truth_with(sine))[0]
    assert [row.low_hz for row in rows] == ([] if expected else [frequency_hz])


def test_an_integrator_was_made_for_nothing():
    assert found(lbt.integrator(PLANT.hardware, gain=0.3), truth_with(SHAKE))[0] == ()


def test_a_drifting_truth_is_refused():
    drift = lbt.models.DriftingVibration(start_hz=17, end_hz=18, duration_s=5, rms_nm=50)
    with pytest.raises(lbt.errors.ProblemError, match="a truth that is stationary"):
        found(lbt.kalman(PLANT), truth_with(drift))
