"""Closed loops of several sensors, against runs of the loop from its equations."""

import numpy as np
import pytest
from support.sensor_loops import (
    AIR,
    FAST,
    LINES,
    MOTIONS,
    RATE_HZ,
    SLOW,
    example_plant,
    impulse,
    run_loop,
    simulated_covariances,
)

import lbt_synth as lbt
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.linear import kalman_riccati
from lbt_synth.loop.budget import plant_budget
from lbt_synth.loop.closed_loop import radii_by_gain
from lbt_synth.models import Accelerometer, PositionLoop, Truth, WavefrontSensor

AGELESS = Accelerometer(
    name="mirror", rate_hz=RATE_HZ, delay_frames=1, channels=("m1", "m2"), noise_m_s2=2e-3
)
SELDOM = WavefrontSensor(name="seldom", rate_hz=50, delay_frames=1.3, noise_nm=4)
THIRD = Accelerometer(
    name="third", rate_hz=RATE_HZ / 3, delay_frames=1, channels=("m1", "m2"), noise_m_s2=2e-3
)
HALF = Accelerometer(
    name="half", rate_hz=RATE_HZ / 2, delay_frames=1.625, channels=("m2",), noise_m_s2=2e-3
)
SLEEPY = Accelerometer(  # its exposures wait, and end within a frame
    name="sleepy", rate_hz=RATE_HZ / 3, delay_frames=2.875, channels=("m1", "m2"), noise_m_s2=2e-3
)
SHELL = PositionLoop.from_bandwidth(natural_frequency_hz=50, damping=0.5, bandwidth_hz=500)
AR3 = lbt.models.ARModel(coefficients=[1.2, -0.3, -0.05], driving_rms_nm=20, frame_rate_hz=RATE_HZ)


def closed(plant, **facts):
    """Return the controller of the Kalman filter, and its loop."""
    controller = plant.controller(kalman_riccati(plant).gain_predictor)
    return controller, lbt.close_loop(plant.hardware, controller, **facts)


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("sensors", [(FAST,), (SLOW,), (FAST, SLOW), (SELDOM,)])
def test_the_residual_of_the_model_is_the_error_of_the_filter(delay, sensors):
    plant = example_plant(sensors, delay_frames=delay)
    P = kalman_riccati(plant).P.reshape(-1, plant.n_states, plant.n_states)
    _, loop = closed(plant)
    rms = np.sqrt(np.mean([np.trace(plant.L @ one @ plant.L.T) for one in P]))
    assert plant_budget(loop, plant).rms_nm == pytest.approx(rms, rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "loop"),
    [
        ({}, {}),
        ({}, {"sensor_gain": 0.6}),
        ({}, {"blind": ("truth",)}),
        ({}, {"blind": ("m1",)}),
        ({"delay_frames": 1.5, "turbulence": AR3}, {}),
        ({"delay_frames": 3, "sensors": (HALF, SLOW)}, {}),
        ({"sensors": (AGELESS,)}, {}),
        ({"sensors": (SLEEPY,)}, {}),
        ({"mirror": SHELL, "influence_matrix": [[2.0, 0.1], [0.3, 1.0]]}, {}),
        ({"sensor_matrix": [[1, 0], [0, 1], [0.5, 0.5]], "noise_nm": [30, 30, 40]}, {}),
    ],
)
def test_budgets_are_what_impulses_leave(changes, loop):
    plant = example_plant(**changes)
    controller, own = closed(plant, **loop)
    budget = plant_budget(own, plant)
    exact = budget.turbulence_nm2, budget.random_vibration_nm2, budget.noise_nm2
    for one, simulated in zip(exact, simulated_covariances(plant, controller, **loop), strict=True):
        assert np.abs(one - simulated).max() < 1e-8 * np.trace(one)


def test_rates_that_do_not_divide_each_other():
    plant = example_plant((THIRD, SELDOM), lines=LINES[:1], motions=MOTIONS[:1])
    assert plant.period == 60
    controller, loop = closed(plant)
    budget = plant_budget(loop, plant)
    *_, noise = simulated_covariances(plant, controller, frames=200)
    assert np.abs(budget.noise_nm2 - noise).max() < 1e-8 * np.trace(noise)


@pytest.mark.parametrize(("age", "period"), [(0, 1), (1, 1), (1.4, 1), (2.4, 2)])
def test_a_sinusoid_leaves_what_a_run_leaves(age, period):
    fast = Accelerometer(
        name="mirror",
        rate_hz=RATE_HZ / period,
        delay_frames=(1 + age) / period,
        channels=("m1",),
        noise_m_s2=2e-3,
        highpass_hz=5.0,
    )
    plant = example_plant((fast, SLOW), motions=({"m1": MOTIONS[0]["m2"]}, {}))
    controller, loop = closed(plant)
    hertz, frames = 62.5, 400
    line = lbt.models.SinusoidalVibration(frequency_hz=hertz, rms_nm=200, direction=(3, 4))
    truth = Truth(turbulence=None, vibrations=(line,), motions=plant.motions[:1])
    budget = lbt.residual_budget(loop, truth)
    # an accelerometer reads -w^2 times the mean position, turned and weakened, some frames ago
    wave = 200 * np.sqrt(2) * np.exp(2j * np.pi * hertz / RATE_HZ * np.arange(frames))
    angle = 2 * np.pi * hertz / RATE_HZ
    late = np.mean(np.exp(-1j * angle * (age - np.arange(period)))) / (1 + 5.0 / (1j * hertz))
    read = -1e-9 * (2 * np.pi * hertz) ** 2 * MOTIONS[0]["m2"].factor * late * wave
    total, added = np.zeros((frames, 2, 2)), np.zeros((frames, 2, 5))
    for run, part in enumerate((np.real, np.imag)):
        total[:, run] = part(wave)[:, None] * np.array([0.6, 0.8])
        added[:, run, 4] = part(read)
    left = run_loop(plant, controller, total, added)[-16:]  # a period of the line and the sensors
    covariance = np.einsum("fri,frj->ij", left, left) / 32
    np.testing.assert_allclose(budget.vibration_nm2, covariance, rtol=1e-8)
    # what is left is a sum of sinusoids: the line, and what the period mixes it to
    complex_left = left[:, 0] + 1j * left[:, 1]
    amplitudes = np.abs(np.fft.fft(complex_left, axis=0)) / 16
    strongest = np.sort(np.abs(budget.line_amplitudes_nm), axis=0)
    np.testing.assert_allclose(strongest, np.sort(amplitudes, axis=0)[-4:], rtol=1e-6, atol=1e-6)


def test_a_spectrum_leaves_the_spectrum_of_what_impulses_leave():
    class Broad:
        def psd(self, frequency_hz):
            return 30 / (1 + (np.asarray(frequency_hz) / 40) ** 2)

    plant = example_plant()
    controller, loop = closed(plant)
    budget = lbt.residual_budget(loop, Truth(turbulence=[Broad(), None], noise_nm=0.0))
    N, frames, first = 4, 512, 16
    entries = [(t, first + t, 0) for t in range(N)]
    total = impulse(first + N + frames, N, 2, entries)
    left = run_loop(plant, controller, total, np.zeros((len(total), N, 6)))
    hertz = (np.arange(1000) + 0.5) * RATE_HZ / 2 / 1000
    powers = np.zeros((len(hertz), 2, 2))
    for phase in range(N):  # of the residual: at lag j it answers an impulse at phase - j
        response = np.zeros((len(hertz), 2), dtype=complex)
        for j in range(frames - N):
            run = (phase - j) % N
            response += left[first + run + j, run] * np.exp(
                -2j * np.pi * hertz[:, None] * j / RATE_HZ
            )
        powers += np.real(response[:, :, None] * response.conj()[:, None, :]) / N
    expected = np.sum(Broad().psd(hertz)[:, None, None] * powers, axis=0) * RATE_HZ / 2 / 1000
    np.testing.assert_allclose(budget.turbulence_nm2, expected, rtol=1e-5, atol=1e-6)


def test_spectra_and_their_ar_models_agree():
    plant = example_plant()
    _, loop = closed(plant)
    by_lyapunov = lbt.residual_budget(loop, Truth(turbulence=AIR))

    class Same:
        def psd(self, frequency_hz):
            return AIR.psd(frequency_hz)

    by_quadrature = lbt.residual_budget(loop, Truth(turbulence=Same()))
    np.testing.assert_allclose(
        by_quadrature.turbulence_nm2, by_lyapunov.turbulence_nm2, rtol=1e-7, atol=1e-6
    )


def test_the_truth_may_have_another_noise_and_gain():
    plant = example_plant()
    controller, loop = closed(plant, sensor_gain=0.8)
    noisy, calm = (
        lbt.residual_budget(loop, Truth(turbulence=None, noise_nm=noise, sensor_gain=0.8)).noise_nm2
        for noise in (75.0, 0.0)
    )
    *_, whole = simulated_covariances(plant, controller, sensor_gain=0.8)
    np.testing.assert_allclose(noisy, whole, rtol=1e-7)
    assert 0 < np.trace(calm) < np.trace(noisy)
    assert lbt.residual_budget(loop, Truth(turbulence=AIR, sensor_gain=0.8)).rms_nm > 0


def test_an_unstable_loop_has_no_budget():
    _, loop = closed(example_plant(), sensor_gain=8.0)
    assert not loop.is_stable
    with pytest.raises(UnstableLoopError, match=r"an unstable one .* at sensor gain 8\)"):
        lbt.residual_budget(loop, Truth(turbulence=AIR, sensor_gain=8.0))


def test_refusals():
    plant = example_plant()
    _, loop = closed(plant)
    with pytest.raises(ProblemError, match="truth's sensor gain 0.9; got 1"):
        lbt.residual_budget(loop, Truth(turbulence=AIR, sensor_gain=0.9))
    with pytest.raises(ProblemError, match="no sensor or channel is called 'm9'"):
        closed(plant, blind=("m9",))
    other, _ = closed(example_plant((FAST,)))
    with pytest.raises(ProblemError, match="6 measurements to 2 commands in a period of 4"):
        lbt.close_loop(plant.hardware, other)
    with pytest.raises(ProblemError, match="sensor_gain"):
        closed(plant, sensor_gain=0.0)
    drifting = lbt.models.DriftingVibration(
        start_hz=20, end_hz=30, duration_s=1, damping=0.01, rms_nm=100
    )
    with pytest.raises(ProblemError, match="stationary"):
        lbt.residual_budget(loop, Truth(turbulence=AIR, vibrations=(drifting,)))


def test_radii_of_many_gains_are_those_of_their_loops():
    plant = example_plant(influence_matrix=[[2.0, 0.1], [0.3, 1.0]])
    controller, _ = closed(plant)
    gains = np.array([0.2, 0.7, 1.0, 1.7])
    found = radii_by_gain(plant.hardware, controller)(gains)
    loops = [closed(plant, sensor_gain=gain)[1].spectral_radius for gain in gains]
    np.testing.assert_allclose(found, loops, rtol=1e-9)
