"""Orthonormal functions with given poles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.shaping import (
    RATE,
)

import lbt_synth as lbt
from lbt_synth.design.shaping.channel import (
    Channel,
    laguerre_basis,
    mode_loop,
    orthonormal_basis,
)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-0.95, 0.99), max_size=4),
    st.lists(st.tuples(st.floats(0.05, 0.999), st.floats(0.01, 3.1)), min_size=1, max_size=5),
)
def test_a_basis_is_orthonormal_and_has_its_poles(real, pairs):
    upper = np.array([r * np.exp(1j * a) for r, a in pairs])
    poles = np.concatenate([upper, upper.conj(), np.array(real, dtype=complex)])
    basis = orthonormal_basis(poles, dt_s=1.0)
    np.testing.assert_allclose(
        basis.A @ basis.A.T + basis.B @ basis.B.T, np.eye(len(poles)), atol=1e-9
    )
    # the characteristic polynomial: the poles themselves are ill-conditioned where they repeat
    np.testing.assert_allclose(np.poly(basis.A), np.poly(poles).real, atol=1e-8)


def test_taps_and_laguerre_functions_are_special_cases():
    f = np.array([0.0, 3.0, 77.0, 400.0])
    z = np.exp(2j * np.pi * f / RATE)[:, None]
    taps = laguerre_basis(5, 0.0, dt_s=1 / RATE).response(f)
    np.testing.assert_allclose(np.abs(taps), 1, atol=1e-12)
    np.testing.assert_allclose(taps**2, (z ** -np.arange(5)) ** 2, atol=1e-12)  # but for signs
    a, k = 0.6, np.arange(5)
    expected = np.sqrt(1 - a * a) * z / (z - a) * ((1 - a * z) / (z - a)) ** k
    found = laguerre_basis(5, a, dt_s=1 / RATE).response(f)
    np.testing.assert_allclose(np.abs(found), np.abs(expected), atol=1e-12)


@pytest.mark.parametrize(
    ("poles", "message"), [([1.0], "inside the unit circle"), ([0.5 + 0.1j], "conjugate pairs")]
)
def test_a_basis_refuses_poles_that_are_none(poles, message):
    with pytest.raises(lbt.errors.ProblemError, match=message):
        orthonormal_basis(np.array(poles, dtype=complex), dt_s=1.0)


@pytest.mark.parametrize("sensor_gain", [1.0, 0.6])
@pytest.mark.parametrize("delay", [1.3, 2.25, 2.49, 3.75])
def test_the_residual_of_holds_is_what_the_image_has_beyond_its_floor(delay, sensor_gain):
    """Of a slow line, whose mean over a hold is interpolated between the two frames of the hold."""
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=delay)
    channel = Channel(hardware=path, basis=laguerre_basis(4, 0.5, dt_s=1 / 800))
    coefficients = np.array([0.5, 0.3, -0.1, 0.2])
    loop = mode_loop(path, channel.basis.parameter(coefficients))
    line = lbt.models.SinusoidalVibration(frequency_hz=15.0, rms_nm=100, direction=(1,))
    truth = lbt.Truth(turbulence=None, noise_nm=7.0, vibrations=(line,), sensor_gain=sensor_gain)
    image = lbt.residual_budget(loop.at(sensor_gain), truth)
    held = lbt.residual_budget(loop.held(sensor_gain), truth, frame_means=True)
    assert held.noise_nm == pytest.approx(image.noise_nm, rel=1e-9)
    assert held.vibration_nm == pytest.approx(image.vibration_nm, rel=5e-3)
    f = np.array([3.0, 90.0, 333.0])
    rows, target = channel.residual_rows(f, sensor_gain)
    steering = channel.steering_rows(f, sensor_gain)
    denominator = 1.0 if steering is None else 1 - steering @ coefficients
    shaped = (rows @ coefficients + target) / denominator
    np.testing.assert_allclose(shaped, loop.held(sensor_gain).sensitivity(f)[:, 0, 0], rtol=1e-9)
    noise = channel.residual_noise_rows(f) @ coefficients / denominator
    np.testing.assert_allclose(
        np.abs(noise), np.abs(loop.held(sensor_gain).noise_transfer(f)[:, 0, 0]), rtol=1e-9
    )
