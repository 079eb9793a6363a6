"""Optimised modal gains from telemetry."""

import numpy as np
import pytest
from support.modal import RATE, integrator_residuals, integrator_run
from support.series import ar_series

import lbt_synth as lbt
from lbt_synth.design.modal import modal_gains, modal_gains_from_telemetry


def test_telemetry_finds_what_the_models_say():
    rng = np.random.default_rng(1)
    n, frames, noise = 40, 60_000, 20.0
    poles = np.linspace(0.9, 0.995, n)
    air = lbt.models.ModalTurbulence(
        coefficients=poles[:, None], driving_rms_nm=np.geomspace(3, 30, n), frame_rate_hz=RATE
    )
    gain = np.linspace(0.5, 1.0, n)
    white = air.driving_rms_nm[:, None] * rng.standard_normal((n, frames))
    total = np.empty((n, frames))
    state = np.zeros(n)
    for k in range(frames):
        state = poles * state + white[:, k]
        total[:, k] = state
    seen = noise * rng.standard_normal((n, frames))
    series = integrator_run(np.full(n, 0.2), total, seen, delay_frames=2.5, sensor_gain=gain)
    known = {"frame_rate_hz": RATE, "delay_frames": 2.5, "sensor_gain": gain}
    exact = modal_gains(air, noise_nm=noise, **known)
    found = modal_gains_from_telemetry(*series, noise_nm=noise, **known)

    def cost(gains):
        path = {"delay_frames": 2.5, "sensor_gain": gain}
        return integrator_residuals(gains, air, noise_nm=noise, **path)

    # what is lost by gains from telemetry, in residual; less where the segments are longer,
    # which tell the modes that are best left alone from those that wander
    assert np.max(cost(found.gains) / exact.rms_nm - 1) < 0.02
    longer = modal_gains_from_telemetry(*series, noise_nm=noise, segment_frames=4096, **known)
    assert np.max(cost(longer.gains) / exact.rms_nm - 1) < 0.01
    assert np.median(np.abs(found.gains / exact.gains - 1)) < 0.1
    # turbulence that is AR1 is not quiet at high frequencies: the noise comes out too high, and
    # nothing is lost by that
    guessed = modal_gains_from_telemetry(*series, **known)
    assert np.all(guessed.noise_nm > 0.97 * noise)
    assert np.max(cost(guessed.gains) / exact.rms_nm - 1) < 0.02


@pytest.mark.parametrize(("frames", "modes"), [(2048, 150), (8192, 60), (60_000, 12)])
@pytest.mark.parametrize(
    ("pole", "driving", "noise"), [(0.9999, 1.0, 15.5), (0.95, 3.0, 8.0), (0.8089, 1.76, 4.0)]
)
def test_scatter_is_not_turbulence(pole, driving, noise, frames, modes):
    """Weak turbulence behind noise: neither gains nor residuals are pushed to one side."""
    rng = np.random.default_rng(frames)
    air = lbt.models.ModalTurbulence(
        coefficients=[[pole]], driving_rms_nm=[driving], frame_rate_hz=RATE
    )
    exact = modal_gains(air, noise_nm=noise, frame_rate_hz=RATE)
    series = integrator_run(
        np.full(modes, 0.1),
        ar_series([pole], driving, modes, frames, rng),
        noise * rng.standard_normal((modes, frames)),
    )
    found = modal_gains_from_telemetry(*series, frame_rate_hz=RATE, noise_nm=noise)
    variances, truth = found.rms_nm**2, exact.rms_nm[0] ** 2
    error = max(np.std(variances) / np.sqrt(modes), 2e-3 * truth)
    assert abs(np.mean(variances) - truth) < 4 * error
    spread = np.std(found.gains) / np.sqrt(modes)
    assert abs(np.mean(found.gains) - exact.gains[0]) < 4 * spread + 0.02 * exact.gains[0]
    # the scatter that the documentation states
    assert np.std(variances) < 4 * noise**2 * np.sqrt(2 / frames)
    # where the noise is put plays no part in the choice of the gain
    guessed = modal_gains_from_telemetry(*series, frame_rate_hz=RATE)
    assert np.quantile(np.abs(guessed.gains / found.gains - 1), 0.9) < 5e-3


@pytest.mark.parametrize("segment_frames", [256, 511])
def test_a_steep_spectrum_does_not_leak(segment_frames):
    """Most of the turbulence lies below the periodogram's first frequency, 3 Hz."""
    rng = np.random.default_rng(3)
    air = lbt.models.ModalTurbulence(
        coefficients=[[0.9999]], driving_rms_nm=[1.0], frame_rate_hz=RATE
    )
    exact = modal_gains(air, noise_nm=2.0, frame_rate_hz=RATE)
    total = ar_series([0.9999], 1.0, 6, 40_000, rng)
    series = integrator_run(np.full(6, 0.2), total, 2.0 * rng.standard_normal(total.shape))
    found = modal_gains_from_telemetry(
        *series,
        frame_rate_hz=RATE,
        noise_nm=2.0,
        segment_frames=segment_frames,
    )
    assert np.mean(found.gains) == pytest.approx(exact.gains[0], rel=0.02)
    assert np.mean(found.rms_nm) == pytest.approx(exact.rms_nm[0], rel=0.02)


def test_residuals_are_at_least_the_propagated_noise():
    """Pure noise, and more of it claimed than there is."""
    rng = np.random.default_rng(4)
    y = 5.0 * rng.standard_normal((5000, 3))
    found = modal_gains_from_telemetry(y, 0 * y, frame_rate_hz=RATE, noise_nm=6.0)
    nothing = lbt.models.ModalTurbulence(
        coefficients=np.zeros((3, 1)), driving_rms_nm=np.full(3, 1e-9), frame_rate_hz=RATE
    )
    least = integrator_residuals(found.gains, nothing, noise_nm=6.0)
    assert np.allclose(found.rms_nm, least, rtol=1e-3)


def test_noise_from_a_quiet_band():
    rng = np.random.default_rng(2)
    frames, noise = 40_000, np.array([[3.0], [30.0]])
    k = np.arange(frames)
    slow = 300 * np.sin(2 * np.pi * 0.5 * k / RATE) + 100 * np.sin(2 * np.pi * 3.1 * k / RATE)
    seen = noise * rng.standard_normal((2, frames))
    series = integrator_run([0.3, 0.3], np.stack([slow, slow]), seen)
    found = modal_gains_from_telemetry(*series, frame_rate_hz=RATE)
    assert np.allclose(found.noise_nm, noise[:, 0], rtol=0.02)
    assert found.gains[0] > found.gains[1]
