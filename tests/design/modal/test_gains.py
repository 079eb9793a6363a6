"""Optimised modal gains, from spectra and from telemetry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter
from support.limits import Anonymous
from support.lqg import shell
from support.modal import RATE, integrator_residual, integrator_residuals, integrator_run, path_of
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.design.modal import modal_gains, modal_gains_from_telemetry
from lbt_synth.errors import DimensionError, NonFiniteError, NumericalError, ProblemError
from lbt_synth.models import ARModel, TabulatedSpectrum


def ar_series(coefficients, driving, modes, frames, rng):
    """Stationary series of one process, (modes, frames)."""
    white = driving * rng.standard_normal((modes, frames + 30_000))
    return lfilter([1.0], [1.0, *(-np.array(coefficients))], white, axis=1)[:, 30_000:]


def process(coefficients, driving_nm):
    return ARModel(coefficients=coefficients, driving_rms_nm=driving_nm, frame_rate_hz=RATE)


LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=200.0, direction=(1,))


def best_integrator(path, truth):
    """Return the gain, and the residual, of the integrator that leaves least in the image."""

    def residual(gain):
        rms_nm = integrator_residual(gain, path, truth)
        return 1e6 * gain if np.isnan(rms_nm) else rms_nm

    grid = np.geomspace(0.001, 2, 20) / truth.sensor_gain
    place = int(np.argmin([*map(residual, grid)]))  # there may be two minima
    bounds = grid[place - 1], grid[place + 1]
    best = minimize_scalar(residual, bounds=bounds, method="bounded", options={"xatol": 1e-7})
    return best.x, best.fun


def air_of(pole, driving, modes=1):
    return process(np.full((modes, 1), pole), np.full(modes, driving))


@pytest.mark.parametrize(("delay", "noise", "sensor_gain"), [(2, 60.0, 0.6), (2.5, 2.0, 1.3)])
def test_agrees_with_the_best_integrator_of_one_mode(air, delay, noise, sensor_gain):
    path, moving = path_of(delay_frames=delay, modes=1), LINE.rms_nm / np.sinc(20 / RATE)
    ar1, sharp = lbt.models.ar1_turbulence(air, frame_rate_hz=RATE), replace(LINE, damping=1e-4)
    density = [4e4, 4e4, 50, 1, 90, 0.5, 0.01]
    table = TabulatedSpectrum(frequency_hz=[0, 1, 5, 30, 31, 32, 400], density_nm2_hz=density)
    spectra = [air, table, ar1, sharp.ar_model(RATE)]
    facts = {"noise_nm": noise, "sensor_gain": sensor_gain}
    gains = modal_gains(spectra, hardware=path, vibrations={2: LINE}, **facts)
    for i, spectrum in enumerate(spectra):
        lines = (replace(LINE, rms_nm=moving),) if spectrum is ar1 else ()
        truth = lbt.Truth(turbulence=spectrum, vibrations=lines, **facts)
        gain, rms_nm = best_integrator(path, truth)
        assert gains.rms_nm[i] == pytest.approx(rms_nm, rel=1e-6)
        # where the answer is exact, so is this
        assert gains.gains[i] == pytest.approx(gain, rel=1e-5 if spectrum is ar1 else 1e-3)
    assert not gains.limited.any()


def test_a_quiet_sensor_is_limited_by_stability():
    slow, fast = process([1.999, -0.99900025], 1.0), process([0.999], 10.0)
    gains = modal_gains([slow, fast], noise_nm=[0.0, 0.5], hardware=path_of(), margin=0.5)
    assert gains.limited.tolist() == [True, False]
    assert gains.gains[0] == pytest.approx(0.5)
    assert np.allclose(gains.limit, 0.5)
    weak = modal_gains([slow], noise_nm=0.0, hardware=path_of(), margin=0.5, sensor_gain=1.25)
    assert weak.gains[0] == pytest.approx(0.4)
    air = ARModel.stack([slow, fast])
    residuals = integrator_residuals(gains.gains, air, noise_nm=[0.0, 0.5])
    assert np.allclose(gains.rms_nm, residuals, rtol=1e-6)


@pytest.mark.parametrize(("bandwidth", "delay"), [(60.0, 2.4), (250.0, 2)])
def test_a_slow_mirror_has_its_own_gains(bandwidth, delay):
    path = path_of(delay_frames=delay, modes=1, mirror=shell(bandwidth))
    air, facts = air_of(0.99, 10.0), {"noise_nm": 5.0, "hardware": path, "sensor_gain": 0.8}
    truth = lbt.Truth(turbulence=air, noise_nm=5.0, sensor_gain=0.8)
    gain, rms_nm = best_integrator(path, truth)
    gains = modal_gains(air, **facts)
    assert gains.gains == pytest.approx(gain, rel=1e-5)
    residual = integrator_residuals(gains.gains, air, **facts)
    assert (*gains.rms_nm, *residual) == pytest.approx((rms_nm, rms_nm), rel=1e-6)
    limits = gains.limit[0] / (1 - 0.001) * np.array([0.999, 1.001])
    unit = facts | {"sensor_gain": 1.0}
    inside, outside = (integrator_residuals([limit], air, **unit) for limit in limits)
    assert (np.isfinite(inside), np.isnan(outside)) == (True, True)
    # and from its telemetry
    rng = np.random.default_rng(6)
    total = ar_series([0.99], 10.0, 8, 20_000, rng)
    noise, facts = 5.0 * rng.standard_normal(total.shape), {"sensor_gain": 0.8, "hardware": path}
    series = integrator_run(np.full(8, gains.gains[0] / 2), total, noise, **facts)
    seen = modal_gains_from_telemetry(*series, noise_nm=5.0, segment_frames=64, **facts)
    assert np.mean(seen.gains) == pytest.approx(gains.gains[0], rel=0.05)
    assert np.mean(seen.rms_nm) == pytest.approx(gains.rms_nm[0], rel=0.02)


def test_bad_input_is_refused():
    ar1, series = process([0.9], 1.0), np.zeros((3000, 2))
    # a spectrum that is below zero at low frequencies, and lines that no quadrature finds twice
    odd = Anonymous(lambda f: np.where(f > 10, -1.0, 1.0))
    comb = Anonymous(lambda f: np.sin(1e9 * f) ** 200)
    nothing = TabulatedSpectrum(frequency_hz=[0, 1], density_nm2_hz=[0, 0])

    def gains(spectra=(ar1,), noise_nm=1, **changes):
        facts = {"noise_nm": noise_nm, "hardware": path_of()} | changes
        return lambda: modal_gains(spectra, **facts)

    def telemetry(y=series, u=series, **changes):
        return lambda: modal_gains_from_telemetry(y, u, hardware=path_of(), **changes)

    slower = path_of(frame_rate_hz=500)
    require_refusals(
        [
            (gains(noise_nm=-1), ProblemError, "noise_nm must be at least 0"),
            (gains(noise_nm=[1, 2]), DimensionError, "one per mode"),
            (gains(margin=0), ProblemError, "margin must be at least"),
            (gains(margin=0.9999), ProblemError, "leave room"),
            (gains(sensor_gain=1e-6), ProblemError, "leave room"),
            (gains(hardware=3), ProblemError, "hardware must be a LoopHardware"),
            (gains([]), ProblemError, "one spectrum per mode"),
            (gains(800), ProblemError, "one spectrum per mode"),
            (gains([ar1, 3]), ProblemError, "one spectrum per mode"),
            (gains([ar1, odd]), ProblemError, "that of mode 1 is not"),
            (gains([comb], 0), NumericalError, "did not settle"),
            (gains(vibrations={0: 3}), ProblemError, "list of Vibration"),
            (gains(hardware=slower), ProblemError, "sampled at the loop's 500 Hz; got 800 Hz"),
            (gains(air_of(0.9, 1.0), hardware=slower), ProblemError, "loop's 500 Hz; got 800 Hz"),
            (gains([nothing], 0), ProblemError, "got none in mode 0"),
            (telemetry(u=series[1:]), DimensionError, "must both be"),
            (telemetry(series[:900], series[:900]), ProblemError, "longer than a segment"),
            (telemetry(series + np.nan), NonFiniteError, "measurements"),
            (telemetry(segment_frames=8), ProblemError, "segment_frames"),
            (telemetry(), ProblemError, "got none in mode 0"),
        ]
    )


def test_telemetry_finds_what_the_models_say():
    n, noise, rng = 40, 20.0, np.random.default_rng(1)
    poles, driving = np.linspace(0.9, 0.995, n), np.geomspace(3, 30, n)
    white = driving[:, None] * rng.standard_normal((n, 60_000))
    total = np.array([lfilter([1], [1, -p], w) for p, w in zip(poles, white, strict=True)])
    facts = {"hardware": path_of(delay_frames=2.5), "sensor_gain": np.linspace(0.5, 1.0, n)}
    seen = noise * rng.standard_normal(total.shape)
    series = integrator_run(np.full(n, 0.2), total, seen, **facts)
    air = process(poles[:, None], driving)
    exact = modal_gains(air, noise_nm=noise, **facts)

    def loss(gains):
        """Return the most that gains from telemetry lose, in residual."""
        residuals = integrator_residuals(gains.gains, air, noise_nm=noise, **facts)
        return np.max(residuals / exact.rms_nm - 1)

    gains = modal_gains_from_telemetry(*series, noise_nm=noise, **facts)
    assert loss(gains) < 0.02
    assert np.median(np.abs(gains.gains / exact.gains - 1)) < 0.1
    # longer segments tell the modes that are best left alone from those that wander
    longer = modal_gains_from_telemetry(*series, noise_nm=noise, segment_frames=4096, **facts)
    assert loss(longer) < 0.01
    # turbulence that is AR1 is not quiet at high frequencies: the noise comes out too high, and
    # nothing is lost by that
    guessed = modal_gains_from_telemetry(*series, **facts)
    assert np.all(guessed.noise_nm > 0.97 * noise)
    assert loss(guessed) < 0.02


@pytest.mark.parametrize(
    ("pole", "driving", "noise", "frames", "modes"),
    [(0.9999, 1.0, 15.5, 8192, 60), (0.95, 3.0, 8.0, 2048, 150), (0.8089, 1.76, 4.0, 60_000, 12)],
)
def test_scatter_is_not_turbulence(pole, driving, noise, frames, modes):
    """Behind noise, weak turbulence pushes neither gains nor residuals to one side."""
    rng = np.random.default_rng(frames)
    exact = modal_gains(air_of(pole, driving), noise_nm=noise, hardware=path_of())
    total = ar_series([pole], driving, modes, frames, rng)
    seen = noise * rng.standard_normal((modes, frames))
    series = integrator_run(np.full(modes, 0.1), total, seen)
    gains = modal_gains_from_telemetry(*series, hardware=path_of(), noise_nm=noise)
    variances, truth = gains.rms_nm**2, exact.rms_nm[0] ** 2
    error = max(np.std(variances) / np.sqrt(modes), 2e-3 * truth)
    assert abs(np.mean(variances) - truth) < 4 * error
    spread = np.std(gains.gains) / np.sqrt(modes)
    assert abs(np.mean(gains.gains) - exact.gains[0]) < 4 * spread + 0.02 * exact.gains[0]
    # the scatter that the documentation states
    assert np.std(variances) < 4 * noise**2 * np.sqrt(2 / frames)
    # where the noise is put plays no part in the choice of the gain
    guessed = modal_gains_from_telemetry(*series, hardware=path_of())
    assert np.quantile(np.abs(guessed.gains / gains.gains - 1), 0.9) < 5e-3


def test_residuals_are_at_least_the_propagated_noise():
    """The series are pure noise, and more of it is claimed than there is."""
    y = 5.0 * np.random.default_rng(4).standard_normal((5000, 3))
    gains = modal_gains_from_telemetry(y, 0 * y, hardware=path_of(), noise_nm=6.0)
    least = integrator_residuals(gains.gains, air_of(0.0, 1e-9, 3), noise_nm=6.0)
    assert np.allclose(gains.rms_nm, least, rtol=1e-3)


def test_noise_from_a_quiet_band():
    noise, k = np.array([[3.0], [30.0]]), np.arange(40_000)
    slow = 300 * np.sin(2 * np.pi * 0.5 * k / RATE) + 100 * np.sin(2 * np.pi * 3.1 * k / RATE)
    seen = noise * np.random.default_rng(2).standard_normal((2, k.size))
    series = integrator_run([0.3, 0.3], np.stack([slow, slow]), seen)
    gains = modal_gains_from_telemetry(*series, hardware=path_of())
    assert np.allclose(gains.noise_nm, noise[:, 0], rtol=0.02)
    assert gains.gains[0] > gains.gains[1]
