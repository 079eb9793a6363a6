"""Orthonormal functions, a mode of the loop, and terms of an objective against the real loop."""

from dataclasses import replace

import numpy as np
import pytest
from support.shaping import AIR, BASIC, NOISE, ONE, RATE, channel, random_coefficients, shaped, spec

import lbt_synth as lbt
from lbt_synth.design.shaping import CommandRms, ResidualVariance, VibrationBand
from lbt_synth.design.shaping.channel import SingleModeLoop, laguerre_basis, mode_loop
from lbt_synth.linear.convex_functions import total_value


@pytest.mark.parametrize("pole", [0.0, -0.3, 0.95])
def test_laguerre_functions_are_orthonormal_and_have_one_pole(pole):
    basis = laguerre_basis(6, pole, dt_s=1 / RATE)
    np.testing.assert_allclose(basis.A @ basis.A.T + basis.B @ basis.B.T, np.eye(6), atol=1e-14)
    f, k = np.array([0.0, 3.0, 77.0, 400.0]), np.arange(6)
    z = np.exp(2j * np.pi * f / RATE)[:, None]
    expected = np.sqrt(1 - pole**2) * z / (z - pole) * ((1 - pole * z) / (z - pole)) ** k
    np.testing.assert_allclose(basis.response(f), expected, atol=1e-12)


def test_a_parameter_of_few_poles_is_truncated_to_itself():
    """What is left out is zero at every frequency, even where it is weighted."""
    basis, f = laguerre_basis(80, 0.5, dt_s=1 / RATE), np.linspace(0, RATE / 2, 600)
    z, pair = np.exp(2j * np.pi * np.arange(4096) / 4096), 0.9 * np.exp(0.3j)
    target = z * (z + 0.3) / ((z - pair) * (z - pair.conjugate()))
    responses = basis.response(np.arange(4096) * RATE / 4096)
    coefficients = np.real(responses.conj().T @ target) / 4096
    few, shorter = basis.truncated(coefficients, 2, f, 1 / (1 + (f / 30) ** 2))
    np.testing.assert_allclose(few.A @ few.A.T + few.B @ few.B.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(np.sort_complex(few.poles), [pair.conjugate(), pair], atol=1e-6)
    truncated, wanted = few.response(f) @ shorter, basis.response(f) @ coefficients
    np.testing.assert_allclose(truncated, wanted, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize(("delay", "sensor_gain"), [(1.3, 1.0), (2.49, 0.6), (3.75, 1.0)])
def test_the_residual_of_holds_is_what_the_image_has_beyond_its_floor(delay, sensor_gain):
    """The mean of a slow line over a hold is interpolated between the two frames of the hold."""
    mode, coefficients = channel(4, 0.5, delay), np.array([0.5, 0.3, -0.1, 0.2])
    loop = mode_loop(mode.hardware, mode.basis.parameter(coefficients))
    held_loop = loop.held(sensor_gain)
    line = lbt.models.SinusoidalVibration(frequency_hz=15.0, rms_nm=100, direction=(1,))
    truth = lbt.Truth(turbulence=None, noise_nm=7.0, vibrations=(line,), sensor_gain=sensor_gain)
    image = lbt.residual_budget(loop.at(sensor_gain), truth)
    held = lbt.residual_budget(held_loop, truth, frame_means=True)
    assert held.noise_nm == pytest.approx(image.noise_nm, rel=1e-9)
    assert held.vibration_nm == pytest.approx(image.vibration_nm, rel=5e-3)
    f = np.array([3.0, 90.0, 333.0])
    rows, target = mode.residual_rows(f, sensor_gain)
    steering = mode.steering_rows(f, sensor_gain)
    denominator = 1.0 if steering is None else 1 - steering @ coefficients
    rejection = (rows @ coefficients + target) / denominator
    np.testing.assert_allclose(rejection, held_loop.sensitivity(f)[:, 0, 0], rtol=1e-9)
    noise = np.abs(mode.residual_noise_rows(f) @ coefficients / denominator)
    response = held_loop.path("noise", "residual").frequency_response(f)[:, 0, 0]
    np.testing.assert_allclose(noise, np.abs(response), rtol=1e-9)


BAND = VibrationBand(low_hz=16.5, high_hz=23.5, rms_nm=797)
TERMS = [
    BASIC,
    replace(BASIC, sensor_gain=0.5),
    ResidualVariance(turbulence=AIR, noise_nm=15.5, sensor_gain=1.2),
    ResidualVariance(turbulence=None, noise_nm=15.5),
    BAND,
    replace(BAND, sensor_gain=0.6),
    replace(BAND, damping=0.02),
]


@pytest.mark.parametrize("delay", [1.0, 2.5])
@pytest.mark.parametrize("term", TERMS, ids=lambda t: t.label)
def test_a_term_over_the_grid_is_the_residual_of_the_real_loop(term, delay):
    mode = channel(delay=delay)
    c = random_coefficients(12) * 0.5
    value = total_value(term.function(mode, spec(terms=[term]).grid(mode, fineness=2)), c)
    exact = term.measured_nm2(mode_loop(mode.hardware, mode.basis.parameter(c)))
    assert value == pytest.approx(exact, rel=2e-3)


def resonance_power(loop, frequency_hz, damping, rms_nm):
    line = lbt.Vibration(frequency_hz=frequency_hz, damping=damping, rms_nm=rms_nm, direction=(1,))
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    return lbt.residual_budget(loop.at(1.0), truth, frame_means=True).rms_nm ** 2


@pytest.mark.parametrize("frequency_hz", [16.5, 20.0, 23.5])
def test_a_band_with_damping_bounds_a_resonance_anywhere_in_it(frequency_hz):
    mode, band = channel(delay=2.0), replace(BAND, damping=0.02)
    loop = mode_loop(mode.hardware, mode.basis.parameter(random_coefficients(12) * 0.5))
    residual_nm2 = resonance_power(loop, frequency_hz, 0.02, 797)
    assert residual_nm2 < band.measured_nm2(loop) < 3 * residual_nm2
    assert BAND.skirts(1000) is None


def test_a_band_bounds_a_wide_resonance_in_a_loop_that_only_removes_its_top():
    line = lbt.Vibration(frequency_hz=300.0, damping=1e-3, rms_nm=100, direction=(1,))
    facts = {"noise_nm": 10, "modes": 1, "frame_rate_hz": 1000}
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=1, frame_rate_hz=1000)
    plant = lbt.tip_tilt_plant(turbulence=slow, vibrations=[line], **facts)
    loop = SingleModeLoop(hardware=plant.hardware, controller=lbt.kalman(plant).controller)
    band = VibrationBand(low_hz=299.9, high_hz=300.1, rms_nm=100, damping=0.3)
    residual_nm2 = resonance_power(loop, 300.0, 0.3, 100)
    assert residual_nm2 < band.measured_nm2(loop) < 1.01 * residual_nm2


def test_skirts_are_those_of_the_resonance_at_the_nearer_end():
    low, high = (
        lbt.Vibration(frequency_hz=f, damping=0.02, rms_nm=797, direction=(1,)).ar_model(200)
        for f in (16.5, 23.5)
    )
    f = np.array([2.0, 12.0, 16.0, 24.0, 30.0, 100.0])
    skirts = replace(BAND, damping=0.02).skirts(200)
    np.testing.assert_allclose(skirts.psd(f), np.where(f < 20, low.psd(f), high.psd(f)), rtol=1e-12)
    assert not skirts.psd([16.5, 20.0, 23.5]).any()


def test_a_narrow_line_of_a_tabulated_spectrum_is_not_missed():
    f0, w = 53.0, 1e-3  # 100 nm rms
    f, density = [1, f0 - w, f0, f0 + w, 300], [1e-3, 1e-3, 1e4 / w, 1e-3, 1e-3]
    line = lbt.models.TabulatedSpectrum(frequency_hz=f, density_nm2_hz=density)
    bounded = shaped(CommandRms(at_most_nm=10, turbulence=line, noise_nm=1e-3))
    loop = lbt.close_loop(ONE, bounded.controller)
    assert 100 * abs(loop.path("noise", "command").frequency_response([f0])[0, 0, 0]) < 10
    rejecting = shaped(terms=[ResidualVariance(turbulence=line, noise_nm=NOISE)], functions=30)
    residual = 100 * abs(lbt.close_loop(ONE, rejecting.controller).sensitivity([f0])[0, 0, 0])
    assert residual < rejecting.objective_nm[0]
