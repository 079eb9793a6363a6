"""Optimised modal gains, from spectra and from telemetry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from support.modal import RATE, integrator_residuals, integrator_run
from support.series import ar_series

import lbt_synth as lbt
from lbt_synth.design.modal import modal_gains, modal_gains_from_telemetry
from lbt_synth.design.modal.gains import _minimise

LINE = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=200.0, direction=(1,))


def best_integrator(path, truth):
    """Return the gain, and the residual, of the integrator that leaves least in the image."""

    def left(gain):
        controller = lbt.Controller(A=1.0, B=gain, C=1.0, D=0.0, dt_s=path.dt_s)
        loop = lbt.close_loop(path, controller, sensor_gain=truth.sensor_gain)
        if not loop.is_stable:
            return 1e6 * gain
        return lbt.residual_budget(loop, truth).rms_nm

    grid = np.geomspace(0.001, 2, 40) / truth.sensor_gain
    place = int(np.argmin([left(gain) for gain in grid]))  # there may be two minima
    bounds = grid[place - 1], grid[place + 1]
    best = minimize_scalar(left, bounds=bounds, method="bounded", options={"xatol": 1e-9})
    return best.x, best.fun


@pytest.mark.parametrize(
    ("delay", "noise", "sensor_gain"), [(1, 15.5, 1.0), (2, 60.0, 0.6), (2.5, 2.0, 1.3)]
)
def test_agrees_with_the_best_integrator_of_one_mode(air, delay, noise, sensor_gain):
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1)
    ar1 = lbt.models.ar1_turbulence(air, frame_rate_hz=RATE)
    table = lbt.models.TabulatedSpectrum(
        frequency_hz=[0, 1, 5, 30, 31, 32, 400], density_nm2_hz=[4e4, 4e4, 50, 1, 90, 0.5, 0.01]
    )
    found = modal_gains(
        [air, ar1, table, ar1],
        noise_nm=noise,
        frame_rate_hz=RATE,
        delay_frames=delay,
        sensor_gain=sensor_gain,
        vibrations={3: LINE},
    )
    for i, (spectrum, lines) in enumerate([(air, ()), (ar1, ()), (table, ()), (ar1, (LINE,))]):
        lines = [replace(line, rms_nm=line.rms_nm / np.sinc(20 / RATE)) for line in lines]
        truth = lbt.Truth(
            turbulence=spectrum, noise_nm=noise, sensor_gain=sensor_gain, vibrations=lines
        )
        gain, rms_nm = best_integrator(path, truth)
        assert found.rms_nm[i] == pytest.approx(rms_nm, rel=1e-6)
        assert found.gains[i] == pytest.approx(gain, rel=1e-3)
        if isinstance(spectrum, lbt.models.ARModel):  # where the answer is exact, so is this
            assert found.gains[i] == pytest.approx(gain, rel=1e-5)
    assert not found.limited.any()


def test_residuals_are_those_of_the_loop():
    rng = np.random.default_rng(0)
    n = 200
    air = lbt.models.ModalTurbulence(
        coefficients=rng.uniform(0.5, 0.999, (n, 1)),
        driving_rms_nm=10 ** rng.uniform(-1, 2, n),
        frame_rate_hz=RATE,
    )
    noise, gain = 10 ** rng.uniform(0, 2, n), rng.uniform(0.3, 1.2, n)
    lines = {5: [LINE], 77: [LINE, LINE]}
    found = modal_gains(
        air,
        noise_nm=noise,
        frame_rate_hz=RATE,
        sensor_gain=gain,
        vibrations=lines,
        delay_frames=2.3,
    )

    def exact(gains):
        known = {"noise_nm": noise, "vibrations": lines, "delay_frames": 2.3, "sensor_gain": gain}
        return integrator_residuals(gains, air, **known)

    least = exact(found.gains)
    assert np.allclose(least, found.rms_nm, rtol=1e-6)
    smallest = 1e-4 * lbt.design.integrator_gain_limit(2.3) / gain
    for factor in (0.9, 0.99, 1.01, 1.1):
        other = np.clip(factor * found.gains, smallest, found.limit)
        assert np.all(exact(other) >= least * (1 - 1e-6))


def test_a_quiet_sensor_is_limited_by_stability():
    fast = lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=10.0, frame_rate_hz=RATE)
    slow = lbt.models.ARModel(
        coefficients=[1.999, -0.99900025], driving_rms_nm=1.0, frame_rate_hz=RATE
    )
    found = modal_gains([slow, fast], noise_nm=[0.0, 0.5], frame_rate_hz=RATE, margin=0.5)
    assert found.limited.tolist() == [True, False]
    assert found.gains[0] == pytest.approx(0.5)
    assert np.allclose(found.limit, 0.5)
    weak = modal_gains([slow], noise_nm=0.0, frame_rate_hz=RATE, margin=0.5, sensor_gain=1.25)
    assert weak.gains[0] == pytest.approx(0.4)
    air = lbt.models.ModalTurbulence.of([slow, fast])
    left = integrator_residuals(found.gains, air, noise_nm=[0.0, 0.5])
    assert np.allclose(found.rms_nm, left, rtol=1e-6)


@given(a=st.floats(0.02, 0.9), b=st.floats(0.01, 10), delta=st.floats(0, 1))
def test_minimum_between_the_points(a, b, delta):
    """A function with the pole that residuals have, minimised without knowing it."""
    h = np.geomspace(1e-4, 0.9999, 161)

    def function(x):
        return (b + (np.log(x) - np.log(a)) ** 2) * (1 + delta * x) / (1 - x)

    highest = 0.999
    place, value = _minimise(h, function(h)[None], 1.0, np.array([highest]))
    best = minimize_scalar(
        lambda log: function(np.exp(log)),
        bounds=(np.log(1e-4), np.log(highest)),
        method="bounded",
        options={"xatol": 1e-10},
    )
    assert value[0] == pytest.approx(best.fun, rel=1e-9)
    assert place[0] == pytest.approx(np.exp(best.x), rel=1e-4)


@pytest.mark.parametrize("damping", [1e-2, 1e-3, 1e-4])
def test_sharp_peaks_of_arrays_are_those_of_models(damping):
    line = lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=200.0, direction=(1,))
    model = line.ar_model(RATE)
    known = {"noise_nm": 15.5, "frame_rate_hz": RATE}
    single = modal_gains([model], **known)
    stacked = modal_gains(lbt.models.ModalTurbulence.of([model]), **known)
    assert stacked.rms_nm[0] == pytest.approx(single.rms_nm[0], rel=1e-6)
    path = lbt.LoopHardware(frame_rate_hz=RATE, modes=1)
    truth = lbt.Truth(turbulence=model, noise_nm=15.5)
    assert stacked.rms_nm[0] == pytest.approx(best_integrator(path, truth)[1], rel=1e-6)


@pytest.mark.parametrize("bandwidth", [60.0, 250.0])
@pytest.mark.parametrize("delay", [2, 2.4])
def test_a_slow_mirror_has_its_own_gains(bandwidth, delay):
    shell = lbt.models.PositionLoop.from_bandwidth(
        natural_frequency_hz=20, damping=0.5, bandwidth_hz=bandwidth
    )
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=RATE)
    path = lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=1, mirror=shell)
    truth = lbt.Truth(turbulence=slow, noise_nm=5.0, sensor_gain=0.8)
    gain, rms_nm = best_integrator(path, truth)
    known = {"delay_frames": delay, "sensor_gain": 0.8, "mirror": shell, "frame_rate_hz": RATE}
    found = modal_gains([slow], noise_nm=5.0, **known)
    assert (found.hardware.mirror, found.hardware.delay_frames) == (shell, delay)
    assert found.gains[0] == pytest.approx(gain, rel=1e-5)
    assert found.rms_nm[0] == pytest.approx(rms_nm, rel=1e-6)
    air = lbt.models.ModalTurbulence.of([slow])
    left = integrator_residuals(found.gains, air, noise_nm=5.0, **known)
    assert left[0] == pytest.approx(found.rms_nm[0], rel=1e-6)
    limit = found.limit[0] / (1 - 0.001)
    unit = known | {"sensor_gain": 1.0, "noise_nm": 5.0}
    integrator_residuals([0.999 * limit], air, **unit)
    with pytest.raises(lbt.errors.UnstableLoopError, match="mode 0"):
        integrator_residuals([1.001 * limit], air, **unit)
    # and from its telemetry
    rng = np.random.default_rng(6)
    total = ar_series([0.99], 10.0, 8, 20_000, rng)
    noise = 5.0 * rng.standard_normal(total.shape)
    series = integrator_run(np.full(8, found.gains[0] / 2), total, noise, **known)
    seen = modal_gains_from_telemetry(*series, noise_nm=5.0, **known)
    assert np.mean(seen.gains) == pytest.approx(found.gains[0], rel=0.05)
    assert np.mean(seen.rms_nm) == pytest.approx(found.rms_nm[0], rel=0.02)


def test_bad_input_is_refused(air):
    known = {"frame_rate_hz": RATE}
    ar1 = lbt.models.ar1_turbulence(air, frame_rate_hz=RATE)

    class Odd:
        def psd(self, frequency_hz):
            return np.where(frequency_hz > 10, -1.0, 1.0)

    class Lines:
        """A comb of lines that no quadrature finds twice."""

        def psd(self, frequency_hz):
            return np.sin(1e9 * frequency_hz) ** 200

    for spectra, arguments, error, words in (
        ([ar1], {"noise_nm": -1}, lbt.errors.ProblemError, "noise_nm must be at least 0"),
        ([ar1], {"noise_nm": [1, 2]}, lbt.errors.DimensionError, "one per mode"),
        ([ar1], {"noise_nm": 1, "margin": 0}, lbt.errors.ProblemError, "margin must be at least"),
        ([ar1], {"noise_nm": 1, "margin": 0.9999}, lbt.errors.ProblemError, "leave room"),
        ([ar1], {"noise_nm": 1, "sensor_gain": 1e-6}, lbt.errors.ProblemError, "leave room"),
        ([ar1], {"noise_nm": 1, "delay_frames": 0}, lbt.errors.ProblemError, "delay_frames"),
        ([], {"noise_nm": 1}, lbt.errors.ProblemError, "one spectrum per mode"),
        (ar1, {"noise_nm": 1}, lbt.errors.ProblemError, "one spectrum per mode"),
        ([ar1, 3], {"noise_nm": 1}, lbt.errors.ProblemError, "one spectrum per mode"),
        ([ar1, Odd()], {"noise_nm": 1}, lbt.errors.ProblemError, "that of mode 1 is not"),
        ([Lines()], {"noise_nm": 0}, lbt.errors.NumericalError, "did not settle"),
        (
            [ar1],
            {"noise_nm": 1, "vibrations": {0: 3}},
            lbt.errors.ProblemError,
            "list of Vibration",
        ),
        (
            [ar1],
            {"noise_nm": 1, "vibrations": {0: None}},
            lbt.errors.ProblemError,
            "list of Vibration",
        ),
        ([ar1], {"noise_nm": 1, "mirror": 3}, lbt.errors.ProblemError, "PositionLoop"),
        (
            [ar1],
            {"noise_nm": 1, "frame_rate_hz": 500},
            lbt.errors.ProblemError,
            "sampled at the loop's 500 Hz; got 800 Hz",
        ),
        (
            lbt.models.ModalTurbulence.of([ar1]),
            {"noise_nm": 1, "frame_rate_hz": 500},
            lbt.errors.ProblemError,
            "sampled at the loop's 500 Hz; got 800 Hz",
        ),
    ):
        with pytest.raises(error, match=words):
            modal_gains(spectra, **(known | arguments))

    nothing = lbt.models.TabulatedSpectrum(frequency_hz=[0, 1], density_nm2_hz=[0, 0])
    with pytest.raises(lbt.errors.ProblemError, match="got none in mode 0"):
        modal_gains([nothing], noise_nm=0, **known)

    series = np.zeros((3000, 2))
    for y, u, arguments, error, words in (
        (series, series[1:], {}, lbt.errors.DimensionError, "must both be"),
        (series[:900], series[:900], {}, lbt.errors.ProblemError, "longer than a segment"),
        (series + np.nan, series, {}, lbt.errors.NonFiniteError, "measurements"),
        (series, series, {"segment_frames": 8}, lbt.errors.ProblemError, "segment_frames"),
        (series, series, {}, lbt.errors.ProblemError, "got none in mode 0"),
    ):
        with pytest.raises(error, match=words):
            modal_gains_from_telemetry(y, u, **(known | arguments))


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
