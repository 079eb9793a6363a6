"""Orthonormal functions, and a mode of the loop."""

import numpy as np
import pytest
from support.shaping import RATE

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import Channel, laguerre_basis, mode_loop


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
    z = np.exp(2j * np.pi * np.arange(4096) / 4096)[:, None]
    pair = 0.9 * np.exp(0.3j)
    target = z * (z + 0.3) / ((z - pair) * (z - pair.conjugate()))
    responses = basis.response(np.arange(4096) * RATE / 4096)
    coefficients = np.real(responses.conj().T @ target[:, 0]) / 4096
    few, shorter = basis.truncated(coefficients, 2, f, 1 / (1 + (f / 30) ** 2))
    np.testing.assert_allclose(few.A @ few.A.T + few.B @ few.B.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(np.sort_complex(few.poles), [pair.conjugate(), pair], atol=1e-6)
    truncated, wanted = few.response(f) @ shorter, basis.response(f) @ coefficients
    np.testing.assert_allclose(truncated, wanted, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize(("delay", "sensor_gain"), [(1.3, 1.0), (2.49, 0.6), (3.75, 1.0)])
def test_the_residual_of_holds_is_what_the_image_has_beyond_its_floor(delay, sensor_gain):
    """The mean of a slow line over a hold is interpolated between the two frames of the hold."""
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=delay)
    channel = Channel(hardware=path, basis=laguerre_basis(4, 0.5, dt_s=1 / 800))
    coefficients = np.array([0.5, 0.3, -0.1, 0.2])
    loop = mode_loop(path, channel.basis.parameter(coefficients))
    held_loop = loop.held(sensor_gain)
    line = lbt.models.SinusoidalVibration(frequency_hz=15.0, rms_nm=100, direction=(1,))
    truth = lbt.Truth(turbulence=None, noise_nm=7.0, vibrations=(line,), sensor_gain=sensor_gain)
    image = lbt.residual_budget(loop.at(sensor_gain), truth)
    held = lbt.residual_budget(held_loop, truth, frame_means=True)
    assert held.noise_nm == pytest.approx(image.noise_nm, rel=1e-9)
    assert held.vibration_nm == pytest.approx(image.vibration_nm, rel=5e-3)
    f = np.array([3.0, 90.0, 333.0])
    rows, target = channel.residual_rows(f, sensor_gain)
    steering = channel.steering_rows(f, sensor_gain)
    denominator = 1.0 if steering is None else 1 - steering @ coefficients
    shaped = (rows @ coefficients + target) / denominator
    np.testing.assert_allclose(shaped, held_loop.sensitivity(f)[:, 0, 0], rtol=1e-9)
    noise = np.abs(channel.residual_noise_rows(f) @ coefficients / denominator)
    response = held_loop.path("noise", "residual").frequency_response(f)[:, 0, 0]
    np.testing.assert_allclose(noise, np.abs(response), rtol=1e-9)
