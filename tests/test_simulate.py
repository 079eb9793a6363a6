"""Time domain against the frame-by-frame loop, python-control and the exact answer."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.loop.simulation.disturbances import draw_disturbance


@given(
    seed=st.integers(0, 1000),
    n=st.integers(1, 5),
    frames=st.integers(1, 700),
    cases=st.integers(1, 3),
)
def test_block_products_are_the_recursion(seed, n, frames, cases):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.999 / max(abs(np.linalg.eigvals(A)))
    system = lbt.linear.StateSpace(
        A=A,
        B=rng.standard_normal((n, 2)),
        C=rng.standard_normal((3, n)),
        D=rng.standard_normal((3, 2)),
    )
    u = rng.standard_normal((cases, frames, 2))
    expected = np.empty((cases, frames, 3))
    for case in range(cases):
        x = np.zeros(n)
        for k in range(frames):
            expected[case, k] = system.C @ x + system.D @ u[case, k]
            x = system.A @ x + system.B @ u[case, k]
    out = lbt.loop.filter_series(system, u)
    assert np.allclose(out, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_filter_series_against_python_control(axis_plant):
    loop = lbt.close_loop(axis_plant.hardware, lbt.kalman(axis_plant).controller)
    u = np.random.default_rng(0).standard_normal((3000, 2))
    _, expected = control.forced_response(loop.system.to_control(), U=u.T)
    assert np.allclose(lbt.loop.filter_series(loop.system, u), expected.T, atol=1e-9)


@pytest.mark.parametrize("delay", [1, 1.4, 2, 2.7, 3])
def test_fast_loop_is_the_loop_as_written(delay):
    rng = np.random.default_rng(2)
    turbulence = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=30, frame_rate_hz=800)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        delay_frames=delay,
        turbulence=turbulence,
        noise_nm=5,
        vibrations=[lbt.Vibration(frequency_hz=25, damping=0.02, rms_nm=100)],
        sensor_matrix=rng.standard_normal((3, 2)),
        influence_matrix=rng.standard_normal((2, 4)),
    )
    controller = lbt.kalman(plant).controller
    truth = lbt.Truth(
        turbulence=turbulence,
        noise_nm=5,
        sensor_gain=0.9,
        vibrations=(lbt.models.SinusoidalVibration(frequency_hz=24, rms_nm=90, direction=(1, 2)),),
    )
    fast, stepped = (
        lbt.simulate(
            k, truth, hardware=plant.hardware, frames=300, cases=2, seed=4, settle_frames=50
        )
        for k in (controller, controller.start())
    )
    for name in ("residual_nm", "commands", "measurements", "total_nm"):
        one, other = getattr(fast, name), getattr(stepped, name)
        assert np.allclose(one, other, atol=1e-9 * np.abs(other).max()), name


def test_simulation_agrees_with_the_exact_answer(config):
    """Within the statistical error, which the scatter of independent runs gives."""
    controller = lbt.kalman(config.plant).controller
    run = lbt.simulate(
        controller, config.truth, hardware=config.hardware, frames=8000, cases=24, seed=3
    )
    exact = lbt.residual_budget(lbt.close_loop(config.hardware, controller), config.truth)
    variances = run.rms_nm**2
    error = variances.std(ddof=1) / np.sqrt(len(variances))
    assert abs(variances.mean() - exact.rms_nm**2) < 4 * error
    assert error < 0.03 * exact.rms_nm**2  # the test has teeth
    strehls = run.strehl(config.imaging)
    scatter = strehls.std(ddof=1) / np.sqrt(len(strehls))
    # the series' own mean is taken out of its image, which only helps
    assert abs(strehls.mean() - lbt.strehl(exact, config.imaging)) < 4 * scatter + 5e-4


def test_drawn_series_have_their_spectrum(air):
    path = lbt.LoopHardware(frame_rate_hz=400, modes=1)
    truth = lbt.Truth(turbulence=air)
    series = draw_disturbance(truth, path, frames=8192, cases=200, rng=np.random.default_rng(0))[
        ..., 0
    ]
    variance = np.mean(series**2, axis=1)
    error = variance.std(ddof=1) / np.sqrt(len(variance))
    assert abs(variance.mean() - air.tilt_rms_nm**2) < 4 * error
    # increments see the high frequencies
    step = np.mean((series[:, 4:] - series[:, :-4]) ** 2, axis=1)
    f = np.geomspace(1e-5, 200, 50_001)
    expected = np.trapezoid(2 * air.psd(f) * (1 - np.cos(2 * np.pi * f * 4 / 400)), f)
    assert abs(step.mean() - expected) < 5 * step.std(ddof=1) / np.sqrt(len(step))


@pytest.mark.parametrize("frames", [100, 1000])
def test_power_is_drawn_whole_however_short_the_series(frames):
    """A line between two bins, and a spectrum that rises towards zero, keep their variance."""
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    steep = lbt.Atmosphere(
        seeing_arcsec=0.8, outer_scale_m=None, wind_speed_m_s=20, diameter_m=8.22
    )
    line = lbt.models.TabulatedSpectrum(
        frequency_hz=[37.2, 37.23, 37.26], density_nm2_hz=[0, 100 / 0.03, 0]
    )
    for spectrum, rms in ((steep, steep.tilt_rms_nm), (line, 10.0)):
        series = draw_disturbance(
            lbt.Truth(turbulence=spectrum),
            path,
            frames=frames,
            cases=3000,
            rng=np.random.default_rng(2),
        )
        assert np.sqrt(np.mean(series**2)) == pytest.approx(rms, rel=0.05)


def test_white_noise_is_drawn_white():
    flat = lbt.models.TabulatedSpectrum(frequency_hz=[0, 400], density_nm2_hz=[1.0, 1.0])
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    series = draw_disturbance(
        lbt.Truth(turbulence=flat), path, frames=8, cases=60_000, rng=np.random.default_rng(3)
    )
    assert np.mean(series**2) == pytest.approx(400, rel=0.01)


def test_runs_beyond_the_memory_are_refused(axis_plant):
    controller = lbt.kalman(axis_plant).controller
    truth = lbt.Truth(turbulence=None, noise_nm=1)
    for size in ({"frames": 10**24}, {"frames": 10**6, "cases": 10**6}):
        with pytest.raises(lbt.errors.ProblemError, match="must fit into 8 GB"):
            lbt.simulate(controller, truth, hardware=axis_plant.hardware, **size)


def test_drawn_ar_series_are_stationary_from_the_first_frame():
    line = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=100, direction=(1,))
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    series = draw_disturbance(
        lbt.Truth(turbulence=None, vibrations=(line,)),
        path,
        frames=40,
        cases=6000,
        rng=np.random.default_rng(1),
    )[..., 0]
    for frame in (0, 1, 20, 39):
        assert series[:, frame].std() == pytest.approx(100, rel=0.05)
    model = line.ar_model(800)
    correlation = np.mean(series[:, 0] * series[:, 1]) / 100**2
    a1, a2 = model.coefficients
    assert correlation == pytest.approx(a1 / (1 - a2), abs=0.05)


def test_seeds_give_the_same_weather_to_every_controller(config):
    hw = config.hardware
    runs = [
        lbt.simulate(d.controller, config.truth, hardware=hw, frames=200, seed=9, settle_frames=100)
        for d in (lbt.integrator(hw, gain=0.3), lbt.integrator(hw, gain=0.6))
    ]
    assert np.array_equal(runs[0].total_nm, runs[1].total_nm)
    assert not np.array_equal(runs[0].residual_nm, runs[1].residual_nm)
    other = lbt.simulate(
        lbt.integrator(hw, gain=0.3).controller,
        config.truth,
        hardware=hw,
        frames=200,
        seed=10,
        settle_frames=100,
    )
    assert not np.array_equal(other.total_nm, runs[0].total_nm)


class Broken:
    def step(self, _y):
        return np.array([np.nan])

    def reset(self):
        pass


def test_wrong_controllers_and_counts_are_refused(axis_plant):
    hw, truth = axis_plant.hardware, lbt.Truth(turbulence=None, noise_nm=1)
    with pytest.raises(lbt.errors.ProblemError, match="must return 1 finite commands"):
        lbt.simulate(Broken(), truth, hardware=hw, frames=10)
    with pytest.raises(lbt.errors.ProblemError, match=r"step\(y\) and reset\(\)"):
        lbt.simulate("controller", truth, hardware=hw, frames=10)
    controller = lbt.kalman(axis_plant).controller
    for wrong in (
        {"frames": 0},
        {"frames": 1.5},
        {"cases": 0},
        {"seed": -1},
        {"settle_frames": -1},
    ):
        with pytest.raises(lbt.errors.ProblemError):
            lbt.simulate(controller, truth, hardware=hw, **({"frames": 10} | wrong))
    with pytest.raises(lbt.errors.DimensionError, match="inputs must be"):
        lbt.loop.filter_series(lbt.linear.StateSpace(A=0.5, B=1.0, C=1.0, D=0.0), np.zeros((5, 2)))
    with pytest.raises(lbt.errors.DimensionError, match="y must have shape"):
        controller.start().step([1.0, 2.0])
    line = lbt.models.SinusoidalVibration(frequency_hz=5, rms_nm=1)
    shaken = lbt.Truth(turbulence=None, vibrations=(line,))
    with pytest.raises(lbt.errors.DimensionError, match="must have 1 components"):
        lbt.simulate(controller, shaken, hardware=hw, frames=10)


def test_axis_of_the_lbt_in_the_time_domain():
    """Truth is the model: the simulated residual is the Kalman filter's 135.958 nm."""
    plant = lbt_axis_plant()
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=plant.vibrations, noise_nm=15.5)
    run = lbt.simulate(
        lbt.kalman(plant).controller, truth, hardware=plant.hardware, frames=4000, cases=50
    )
    variances = run.rms_nm**2
    error = variances.std(ddof=1) / np.sqrt(len(variances))
    assert abs(variances.mean() - 135.958**2) < 4 * error


def test_a_line_above_nyquist_is_refused_as_in_the_exact_answer(axis_plant):
    line = lbt.models.SinusoidalVibration(frequency_hz=600, rms_nm=1, direction=(1,))
    truth = lbt.Truth(turbulence=None, vibrations=(line,))
    with pytest.raises(
        lbt.errors.ProblemError, match="below the Nyquist frequency 400 Hz; got 600 Hz"
    ):
        lbt.simulate(
            lbt.kalman(axis_plant).controller, truth, hardware=axis_plant.hardware, frames=10
        )
