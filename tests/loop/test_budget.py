"""The exact residual of a loop against closed forms, brute force and runs of the loop."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import trapezoid
from support import predictions
from support.continuous_loops import noise_covariance, power_of_two_sensors, sinusoid_powers
from support.plants import lbt_axis_plant
from support.sensor_loops import (
    AIR,
    FAST,
    MOTIONS,
    RATE_HZ,
    example_plant,
    impulse,
    run_loop,
    simulated_covariances,
)
from support.sensor_loops import LINES as SHAKES
from support.sensor_loops import SLOW as OTHER
from support.uneven_axes import LINES, LOOPS, QUICK, RATE, SLOW, TABLE, one_axis

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.linear import kalman_riccati
from lbt_synth.loop.budget import residual_budget
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


class Anonymous:
    """A spectrum that hides that it is an AR model, so that it goes through quadrature.

    It is that of the means over frames, or of the phase that has them.
    """

    def __init__(self, model, *, of_means=True):
        self.model, self.of_means = model, of_means

    def psd(self, frequency_hz):
        share = 1.0 if self.of_means else np.sinc(frequency_hz / self.model.frame_rate_hz) ** 2
        return self.model.psd(frequency_hz) / share


class Broad:
    """A smooth spectrum of no model."""

    def psd(self, frequency_hz):
        return 30 / (1 + (np.asarray(frequency_hz) / 40) ** 2)


def sinusoid(frequency_hz, rms_nm, direction=(1, 0)):
    return lbt.models.SinusoidalVibration(
        frequency_hz=frequency_hz, rms_nm=rms_nm, direction=direction
    )


def test_noise_of_an_integrator_has_a_closed_form():
    """Delay 1: variance g / (2 - g); delay 2: g (from the Jury table) (2 + g) / ((2 - g ...)."""
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    for g in (0.1, 0.7, 1.6):
        loop = lbt.close_loop(path, lbt.integrator(path, gain=g).controller)
        budget = lbt.residual_budget(loop, Truth(turbulence=None, noise_nm=2.0))
        assert budget.noise_nm**2 == pytest.approx(4 * g / (2 - g), rel=1e-9)


@pytest.mark.parametrize(
    ("gain", "model"),
    [
        (
            0.4,
            lbt.models.ARModel(
                coefficients=[1.997477, -0.997555], driving_rms_nm=0.37, frame_rate_hz=800
            ),
        ),
        (1.0, lbt.Vibration(frequency_hz=17, damping=0.005, rms_nm=300).ar_model(800)),
    ],
)
def test_quadrature_agrees_with_the_lyapunov_equation(gain, model):
    plant = lbt_axis_plant(modes=2)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller, sensor_gain=gain)
    for frame_means in (True, False):
        exact, quadrature = (
            lbt.residual_budget(
                loop, Truth(turbulence=source, sensor_gain=gain), frame_means=frame_means
            )
            for source in (model, Anonymous(model, of_means=frame_means))
        )
        for name in ("turbulence_nm2", "within_nm2"):
            one, other = getattr(exact, name), getattr(quadrature, name)
            assert np.allclose(other, one, rtol=2e-4, atol=1e-9 * one.max())


def test_a_measured_spectrum_against_brute_force():
    rng = np.random.default_rng(0)
    f = np.linspace(5, 100, 3393)
    lines = sum(40 / (1 + ((f - c) / w) ** 2) for c, w in ((10, 0.1), (48.3, 0.03), (72.5, 0.05)))
    table = lbt.models.TabulatedSpectrum(
        frequency_hz=f, density_nm2_hz=lines * rng.uniform(0.2, 1, f.size)
    )
    plant = lbt_axis_plant()
    loop = lbt.close_loop(plant.hardware, lbt.integrator(plant.hardware, gain=0.4).controller)
    # a triangle of unit area leaves the rejection at its place
    narrow = lbt.models.TabulatedSpectrum(
        frequency_hz=[37.297, 37.3, 37.303], density_nm2_hz=[0, 100 / 0.003, 0]
    )
    left = abs(loop.sensitivity([37.3])[0, 0, 0]) * np.sinc(37.3 / 800)
    line = lbt.residual_budget(loop, Truth(turbulence=narrow))
    assert line.turbulence_nm == pytest.approx(10 * left, rel=1e-3)
    fine = np.linspace(5, 100, 3392 * 20 + 1)
    power = np.abs(loop.sensitivity(fine)[:, 0, 0]) ** 2
    share = np.sinc(fine / 800) ** 2
    budget = lbt.residual_budget(loop, Truth(turbulence=table))
    expected = trapezoid(table.psd(fine) * power * share, fine)
    assert budget.turbulence_nm**2 == pytest.approx(expected, rel=1e-5)
    expected = trapezoid(table.psd(fine) * (1 - share), fine)
    assert budget.within_nm**2 == pytest.approx(expected, rel=1e-5)


def test_parts_of_the_budget_add_up():
    plant = lbt_axis_plant(modes=2)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    truth = Truth(
        turbulence=plant.turbulence[0],
        noise_nm=15.5,
        vibrations=(
            lbt.models.SinusoidalVibration(frequency_hz=19, rms_nm=50),
            lbt.Vibration(frequency_hz=31, damping=0.01, rms_nm=20, direction=(0, 1)),
        ),
    )
    b = lbt.residual_budget(loop, truth)
    names = ("turbulence", "vibration", "noise", "within")
    assert b.rms_nm**2 == pytest.approx(sum(getattr(b, f"{name}_nm") ** 2 for name in names))
    assert np.allclose(b.total_nm2, sum(getattr(b, f"{name}_nm2") for name in names))
    lines = sum(np.real(np.outer(a, a.conj())) / 2 for a in b.line_amplitudes_nm)
    assert np.allclose(b.gaussian_nm2, b.total_nm2 - lines)


def test_loops_refuse_what_does_not_fit():
    path = lbt.LoopHardware(frame_rate_hz=800)
    lazy = lbt.integrator(path, gain=0.3).controller
    with pytest.raises(DimensionError, match="map 1 measurements to 1 commands; got 2 to 2"):
        lbt.close_loop(lbt.LoopHardware(frame_rate_hz=800, modes=1), lazy)
    with pytest.raises(
        ProblemError, match="must run at the loop's 500 Hz; got one designed for 800"
    ):
        lbt.close_loop(lbt.LoopHardware(frame_rate_hz=500), lazy)
    loop = lbt.close_loop(path, lazy)
    with pytest.raises(ProblemError, match="truth's sensor gain 0.5; got 1"):
        lbt.residual_budget(loop, Truth(turbulence=None, sensor_gain=0.5))
    line = lbt.models.SinusoidalVibration(frequency_hz=10, rms_nm=1, direction=(1, 0, 0))
    with pytest.raises(DimensionError, match="must have 2 components"):
        lbt.residual_budget(loop, Truth(turbulence=None, vibrations=(line,)))
    fast = lbt.models.SinusoidalVibration(frequency_hz=600, rms_nm=1)
    with pytest.raises(ProblemError, match="below the Nyquist"):
        lbt.residual_budget(loop, Truth(turbulence=None, vibrations=(fast,)))
    other_rate = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=1, frame_rate_hz=100)
    with pytest.raises(ProblemError, match="must be sampled at the loop's 800 Hz"):
        lbt.residual_budget(loop, Truth(turbulence=other_rate))


uneven = partial(Truth, noise_nm=(15.5, 6.0), sensor_gain=0.8)


@pytest.mark.parametrize("spectra", [(SLOW, TABLE), (None, QUICK)])
def test_axes_without_coupling_are_loops_of_their_own(spectra):
    both, single = LOOPS
    truth = uneven(turbulence=spectra, vibrations=LINES)
    budget = lbt.residual_budget(
        lbt.close_loop(both, lbt.integrator(both, gain=0.4).controller, sensor_gain=0.8), truth
    )
    limit = lbt.loop.least_residual(both, truth)
    for axis in (0, 1):
        loop = lbt.close_loop(single, lbt.integrator(single, gain=0.4).controller, sensor_gain=0.8)
        alone = one_axis(truth, axis)
        own = lbt.residual_budget(loop, alone)
        for name in ("turbulence_nm2", "noise_nm2", "vibration_nm2"):
            assert getattr(budget, name)[axis, axis] == pytest.approx(
                getattr(own, name)[0, 0], rel=1e-9
            ), name
        assert limit.variance_nm2[axis] == pytest.approx(
            lbt.loop.least_residual(single, alone).variance_nm2[0], rel=1e-9
        )
    assert abs(budget.turbulence_nm2[0, 1]) < 1e-9


def test_coupled_axes_against_the_frequency_response():
    """A loop that mixes the axes: the sum of |S e_i|^2 S_i by brute force."""
    path = lbt.LoopHardware(
        frame_rate_hz=RATE, sensor_matrix=[[1.0, 0.2], [-0.1, 0.7]], influence_matrix=np.eye(2)
    )
    controller = lbt.integrator(lbt.LoopHardware(frame_rate_hz=RATE), gain=0.3).controller
    loop = lbt.close_loop(path, controller)
    truth = Truth(turbulence=[SLOW, TABLE], noise_nm=[3.0, 9.0])
    f = (np.arange(100_000) + 0.5) * RATE / 2 / 100_000
    S, N = loop.sensitivity(f), loop.noise_transfer(f)
    density = np.stack([SLOW.psd(f), TABLE.psd(f)], axis=-1)
    white = np.array([3.0, 9.0]) ** 2 / (RATE / 2)
    share = np.sinc(f / RATE)[:, None] ** np.array([0, 2])  # a process is one of means
    seen = density * share
    want = np.einsum("fij,fj,fkj->ik", S, seen, S.conj()).real * (f[1] - f[0])
    noise = np.einsum("fij,j,fkj->ik", N, white, N.conj()).real * (f[1] - f[0])
    budget = lbt.residual_budget(loop, truth)
    np.testing.assert_allclose(budget.turbulence_nm2, want, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(budget.noise_nm2, noise, rtol=1e-5, atol=1e-4)
    moving = density * (np.sinc(f / RATE)[:, None] ** np.array([-2, 0]) - share)
    within = np.diag(moving.sum(axis=0) * (f[1] - f[0]))
    np.testing.assert_allclose(budget.within_nm2, within, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), predictions.CASES)
def test_the_budget_of_a_model_is_that_of_its_truth(delay, gain, mirror, sensor):
    plant = predictions.a_plant(delay=delay, gain=gain, mirror=mirror, sensor=sensor)
    controller = lbt.integrator(plant.hardware, gain=0.2).controller
    loop = lbt.close_loop(plant.hardware, controller)
    bare = predictions.a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    scaled = lbt.close_loop(bare, controller, sensor_gain=gain)
    for met, frame_means in (
        (predictions.a_truth(), True),
        (predictions.truth_of_all_moments(), False),
    ):
        own = lbt.residual_budget(loop, plant, frame_means=frame_means)
        other = lbt.residual_budget(loop, met, frame_means=frame_means)
        for name in ("turbulence_nm2", "noise_nm2", "random_vibration_nm2", "total_nm2"):
            one, two = getattr(own, name), getattr(other, name)
            np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9)
        again = lbt.residual_budget(scaled, plant, frame_means=frame_means)
        np.testing.assert_allclose(again.total_nm2, own.total_nm2, rtol=1e-9, atol=1e-9)


def test_a_budget_of_no_loop_or_no_plant_is_refused():
    plant = predictions.a_plant()
    unstable = lbt.close_loop(
        plant.hardware, lbt.integrator(plant.hardware, gain=0.9).controller, sensor_gain=1.0
    )
    wild = lbt.Controller(
        A=np.eye(2), B=3 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / predictions.RATE
    )
    assert unstable.is_stable
    with pytest.raises(UnstableLoopError):
        lbt.residual_budget(lbt.close_loop(plant.hardware, wild), plant)
    with pytest.raises(ProblemError, match="expected a Truth"):
        lbt.residual_budget(unstable, plant.hardware)
    with pytest.raises(ProblemError, match="must be a ClosedLoop"):
        lbt.residual_budget(unstable.system, plant)
    with pytest.raises(ProblemError, match="expected a TipTiltPlant"):
        lbt.design.model_integrator(predictions.a_truth())


def test_what_is_left_of_strong_slow_lines_keeps_its_digits():
    """It is 1e-5 of the lines; the loop is the optimal one, which leaves the limit."""
    air = lbt.models.ARModel(coefficients=[0.9998], driving_rms_nm=0.01, frame_rate_hz=4000)
    lines = [
        lbt.Vibration(frequency_hz=0.2, damping=1e-3, rms_nm=1000, direction=(1,)),
        lbt.Vibration(frequency_hz=0.1, damping=0.05, rms_nm=300, direction=(1,)),
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=4000, turbulence=air, noise_nm=0.03, vibrations=lines, modes=1
    )
    truth = Truth(turbulence=air, vibrations=lines, noise_nm=0.03)
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant))
    for frame_means, apart in ((True, 1e-9), (False, 1e-6)):
        found = lbt.residual_budget(loop, truth, frame_means=frame_means)
        limit = lbt.loop.least_residual(plant.hardware, truth, frame_means=frame_means)
        assert found.rms_nm == pytest.approx(limit.rms_nm, rel=apart)
    assert lbt.lqg(plant).certificate.passed


@pytest.mark.parametrize("density", [-1.0, 1j])
def test_a_spectrum_that_is_none_is_refused(density):
    class Odd:
        def psd(self, frequency_hz):
            return np.full(frequency_hz.shape, density)

    path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3))
    truth = Truth(turbulence=Odd(), noise_nm=1.0)
    for compute in (
        lambda: lbt.residual_budget(loop, truth),
        lambda: lbt.loop.least_residual(path, truth),
    ):
        with pytest.raises(ProblemError, match="one finite number of at least 0"):
            compute()


def closed(plant, **facts):
    """Return the controller of the Kalman filter, and its loop."""
    controller = plant.controller(kalman_riccati(plant).gain_predictor)
    return controller, lbt.close_loop(plant.hardware, controller, **facts)


@pytest.mark.parametrize(("delay", "sensors"), [(1, (FAST, OTHER)), (2, (FAST,)), (3, (SELDOM,))])
def test_the_residual_of_the_model_is_the_error_of_the_filter(delay, sensors):
    plant = example_plant(sensors, delay_frames=delay)
    P = kalman_riccati(plant).P.reshape(-1, plant.n_states, plant.n_states)
    _, loop = closed(plant)
    rms = np.sqrt(np.mean([np.trace(plant.L @ one @ plant.L.T) for one in P]))
    budget = residual_budget(loop, plant, frame_means=True)
    assert budget.rms_nm == pytest.approx(rms, rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "loop"),
    [
        ({}, {}),
        ({}, {"sensor_gain": 0.6}),
        ({}, {"blind": ("truth", "m1")}),
        ({"delay_frames": 1.5, "turbulence": AR3}, {}),
        ({"delay_frames": 3, "sensors": (HALF, OTHER)}, {}),
        ({"sensors": (AGELESS,)}, {}),
        ({"sensors": (SLEEPY,)}, {}),
        ({"mirror": SHELL, "influence_matrix": [[2.0, 0.1], [0.3, 1.0]]}, {}),
        ({"sensor_matrix": [[1, 0], [0, 1], [0.5, 0.5]], "noise_nm": [30, 30, 40]}, {}),
    ],
)
def test_budgets_are_what_impulses_leave(changes, loop):
    plant = example_plant(**changes)
    controller, own = closed(plant, **loop)
    budget = residual_budget(own, plant, frame_means=True)
    exact = budget.turbulence_nm2, budget.random_vibration_nm2, budget.noise_nm2
    for one, simulated in zip(exact, simulated_covariances(plant, controller, **loop), strict=True):
        assert np.abs(one - simulated).max() < 1e-8 * np.trace(one)


def test_rates_that_do_not_divide_each_other():
    plant = example_plant((THIRD, SELDOM), lines=SHAKES[:1], motions=MOTIONS[:1])
    assert plant.period == 60
    controller, loop = closed(plant)
    budget = residual_budget(loop, plant)
    *_, noise = simulated_covariances(plant, controller, frames=200)
    assert np.abs(budget.noise_nm2 - noise).max() < 1e-8 * np.trace(noise)


@pytest.mark.parametrize(("age", "period"), [(0, 1), (2.4, 2)])
def test_a_sinusoid_leaves_what_a_run_leaves(age, period):
    fast = Accelerometer(
        name="mirror",
        rate_hz=RATE_HZ / period,
        delay_frames=(1 + age) / period,
        channels=("m1",),
        noise_m_s2=2e-3,
        highpass_hz=5.0,
    )
    plant = example_plant((fast, OTHER), motions=({"m1": MOTIONS[0]["m2"]}, {}))
    controller, loop = closed(plant)
    hertz, frames = 62.5, 400
    line = lbt.models.SinusoidalVibration(frequency_hz=hertz, rms_nm=200, direction=(3, 4))
    truth = Truth(turbulence=None, vibrations=(line,), motions=plant.motions[:1])
    budget = lbt.residual_budget(loop, truth, frame_means=True)
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
    plant = example_plant()
    controller, loop = closed(plant)
    truth = Truth(turbulence=[Broad(), None], noise_nm=0.0)
    budget = lbt.residual_budget(loop, truth, frame_means=True)
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


def test_refusals():
    plant = example_plant()
    _, loop = closed(plant, sensor_gain=8.0)
    assert not loop.is_stable
    with pytest.raises(UnstableLoopError, match=r"an unstable one .* at sensor gain 8\)"):
        lbt.residual_budget(loop, Truth(turbulence=AIR, sensor_gain=8.0))
    _, loop = closed(plant)
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


def a_shell(**changes):
    facts = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 150}
    return PositionLoop.from_bandwidth(**(facts | {"sampling_hz": 8000.0} | changes))


MIRRORS = {"settled": None, "shell": a_shell(), "ramp": a_shell(ramp_samples=4, delay_samples=0)}


@pytest.mark.parametrize(
    ("mirror", "delay"), [("settled", 1), ("settled", 2.9), ("shell", 2.49), ("ramp", 3)]
)
def test_the_image_has_what_a_run_in_small_steps_leaves(mirror, delay):
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, modes=1, mirror=MIRRORS[mirror])
    controller, hertz = lbt.integrator(path, gain=0.2).controller, np.array([3, 20, 62, 150, 390])
    powers = sinusoid_powers(path, controller, hertz, (1.0,), frames=150)[:, 0, 0]
    loop, rms_nm = lbt.close_loop(path, controller), np.array([500.0, 100.0, 50.0, 20.0, 10.0])
    lines = [sinusoid(f, rms, (1,)) for f, rms in zip(hertz, rms_nm, strict=True)]
    for line, power in zip(lines, powers, strict=True):
        budget = lbt.residual_budget(loop, Truth(turbulence=None, vibrations=(line,)))
        assert budget.rms_nm**2 == pytest.approx(line.rms_nm**2 * power, rel=1e-4)
    noise = noise_covariance(path, controller, [15.5], frames=150)[0, 0]
    whole = lbt.residual_budget(loop, Truth(turbulence=None, vibrations=lines, noise_nm=15.5))
    assert whole.rms_nm**2 == pytest.approx(rms_nm**2 @ powers + noise, rel=1e-4)
    assert whole.noise_nm**2 <= noise * (1 + 1e-4)
    calm = lbt.residual_budget(loop, Truth(turbulence=None, noise_nm=15.5))
    assert calm.rms_nm**2 == pytest.approx(noise, rel=1e-4)
    if mirror == "settled":
        assert calm.within_nm == pytest.approx(0, abs=1e-6)
        assert whole.within_nm**2 == pytest.approx(
            rms_nm**2 @ (1 - np.sinc(hertz / 800) ** 2), rel=1e-9
        )


@pytest.mark.parametrize(("mirror", "delay"), [("settled", 2.49), ("shell", 2)])
def test_coupled_modes_have_what_a_run_in_small_steps_leaves(mirror, delay):
    path = lbt.LoopHardware(
        frame_rate_hz=800,
        delay_frames=delay,
        sensor_matrix=[[1.0, 0.2], [-0.1, 0.7], [0.3, 0.3]],
        influence_matrix=[[1.0, 0.1], [0.3, 0.8]],
        mirror=MIRRORS[mirror],
    )
    B = 0.3 * np.linalg.pinv(path.sensor @ path.influence) + [[0, 0.05, 0], [0.02, 0, 0]]
    controller = lbt.Controller(A=np.eye(2), B=B, C=np.eye(2), D=np.zeros((2, 3)), dt_s=1 / 800)
    along, noise_nm = np.array([0.6, 0.8]), [5.0, 9.0, 15.0]
    left = 100**2 * sinusoid_powers(path, controller, [62.0], along, frames=150, sensor_gain=0.8)
    white = noise_covariance(path, controller, noise_nm, frames=150, sensor_gain=0.8)
    loop = lbt.close_loop(path, controller, sensor_gain=0.8)
    line = sinusoid(62.0, 100.0, tuple(along))
    for lines, noise, expected in (((line,), 0.0, left[0]), ((), noise_nm, white)):
        truth = Truth(turbulence=None, vibrations=lines, noise_nm=noise, sensor_gain=0.8)
        budget = lbt.residual_budget(loop, truth)
        assert np.abs(budget.total_nm2 - expected).max() < 1e-4 * np.trace(expected)


@pytest.mark.parametrize(("mirror", "delay"), [("settled", 2), ("shell", 2.25)])
def test_processes_and_spectra_are_sums_of_waves_in_the_image(mirror, delay):
    """Of a process each frame has the mean: in the phase there is ``1 / sinc^2`` as much."""
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay, modes=1, mirror=MIRRORS[mirror])
    controller = lbt.integrator(path, gain=0.2).controller
    x, weight = np.polynomial.legendre.leggauss(60)
    hertz = 200 * (1 + x)
    powers = sinusoid_powers(path, controller, hertz, (1.0,), frames=150)[:, 0, 0]
    share = np.sinc(hertz / 800) ** 2
    model = lbt.models.ARModel(coefficients=[0.7], driving_rms_nm=30, frame_rate_hz=800)
    line = lbt.Vibration(frequency_hz=60, damping=0.3, rms_nm=100, direction=(1,))
    loop, shaken = lbt.close_loop(path, controller), line.ar_model(800).psd(hertz)
    for truth, density in (
        (Truth(turbulence=model), model.psd(hertz) / share),
        (Truth(turbulence=Anonymous(model)), model.psd(hertz)),
        (Truth(turbulence=None, vibrations=(line,)), shaken * np.sinc(60 / 800) ** 2 / share),
    ):
        expected = 200 * weight @ (density * powers)
        assert lbt.residual_budget(loop, truth).rms_nm ** 2 == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("delay", [2, 2.49])
def test_a_loop_of_two_sensors_has_what_a_run_in_small_steps_leaves(delay):
    plant = example_plant((OTHER,), delay_frames=delay)
    controller, loop = closed(plant)
    truth = Truth(turbulence=None, vibrations=(sinusoid(62.5, 100, (3, 4)),))
    budget = lbt.residual_budget(loop, truth)
    expected = 100**2 * power_of_two_sensors(plant, controller, 62.5, (0.6, 0.8))
    np.testing.assert_allclose(budget.vibration_nm2 + budget.within_nm2, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("mirror", "delay", "frame_means"),
    [("settled", 2.49, False), ("shell", 1, True), ("ramp", 2.25, False)],
)
def test_an_ensemble_leaves_what_its_loops_leave(mirror, delay, frame_means):
    sensor = [[1.0, 0.2], [-0.1, 0.7]]
    path = lbt.LoopHardware(
        frame_rate_hz=800, delay_frames=delay, mirror=MIRRORS[mirror], sensor_matrix=sensor
    )
    B = 0.3 * np.linalg.inv(path.sensor @ path.influence) + [[0, 0.05], [0.02, 0]]
    controller = lbt.Controller(A=np.eye(2), B=B, C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / 800)
    spectra = [(Broad(), None), (None, SLOW), (QUICK, QUICK), (TABLE, SLOW), None]
    drawn = [{"damping": 0.01}, {"damping": None}]
    for spectrum, damped in zip([*spectra, None], [None, None, None, *drawn, None], strict=True):
        facts = {"frequency_hz": 31.0, "rms_nm": 200.0, "direction": (1, 0.5)}
        lines, own = [], ()
        if damped is not None:
            lines = [lbt.loop.EnsembleVibration(**facts, **damped)]
            kind = lbt.Vibration if damped["damping"] else lbt.models.SinusoidalVibration
            own = (kind(**facts, **({k: v for k, v in damped.items() if v})),)
        gains = [0.7, 1.0]
        ensemble = lbt.loop.LoopEnsemble(
            sensor_gain=gains, turbulence=spectrum, noise_nm=9.0, vibrations=lines
        )
        found = lbt.loop.ensemble_residuals(controller, path, ensemble, frame_means=frame_means)
        for i, gain in enumerate(gains):
            truth = Truth(turbulence=spectrum, noise_nm=9.0, vibrations=own, sensor_gain=gain)
            loop = lbt.close_loop(path, controller, sensor_gain=gain)
            budget = lbt.residual_budget(loop, truth, frame_means=frame_means)
            assert found.rms_nm[i] == pytest.approx(budget.rms_nm, rel=1e-6)
            for name in ("turbulence_nm2", "noise_nm2", "random_vibration_nm2", "within_nm2"):
                one, other = getattr(found, name)[i], getattr(budget, name)
                assert np.abs(one - other).max() < 2e-6 * max(np.trace(other), 1e-3), name
