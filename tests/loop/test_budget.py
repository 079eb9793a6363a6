"""The exact residual of a loop against closed forms, brute force and runs of the loop."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import expm
from support import predictions
from support.plants import lbt_axis_plant
from support.refusals import require_refusals
from support.sensor_loops import (
    FAST,
    MOTIONS,
    RATE_HZ,
    age_frames,
    example_plant,
    frames_per_reading,
    held_mean,
    impulse,
    run_loop,
    simulated_covariances,
)
from support.sensor_loops import LINES as SHAKES
from support.sensor_loops import SLOW as OTHER

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.budget import residual_budget, residual_spectrum
from lbt_synth.models import Accelerometer, Motion, PositionLoop, Truth, WavefrontSensor

# Loops in continuous time, run in small steps from their equations, without the package's.
# The camera sees the phase less the mirror in the middle of each step.

STEPS = 400


class _Shell:
    """A mirror in its local loop, run sample by sample; commands are (runs, m)."""

    def __init__(self, loop, rate_hz, shape):
        self.loop, self.samples = loop, round(loop.sampling_hz / rate_hz)
        w, dt = 2 * np.pi * loop.natural_frequency_hz, 1 / loop.sampling_hz
        motion = np.zeros((3, 3))  # of position, velocity and a held acceleration
        motion[0, 1], motion[1] = 1.0, (-(w**2), -2 * loop.damping * w, 1.0)
        per_sample = STEPS // self.samples
        middles = (np.arange(per_sample) + 0.5) / per_sample
        self.between = np.stack([expm(motion * dt * part)[0] for part in middles])
        self.over = expm(motion * dt)
        self.stiffness = loop.feed_forward * w**2
        self.x, self.v, self.last = np.zeros((3, *shape), dtype=complex)
        self.waiting = [np.zeros(shape, dtype=complex)] * loop.delay_samples
        self.command = np.zeros(shape, dtype=complex)

    def hold(self, command):
        """Return the positions (STEPS, runs, m) while a command holds."""
        loop, out = self.loop, []
        for i in range(self.samples):
            share = min(1.0, (i + 1) / loop.ramp_samples)
            r = share * command + (1 - share) * self.command
            force = self.stiffness * r + loop.proportional_per_s2 * (r - self.x)
            force = force - loop.derivative_per_s * (self.x - self.last) * loop.sampling_hz
            self.waiting.append(force)
            state = np.stack([self.x, self.v, self.waiting.pop(0)])
            out.append(np.tensordot(self.between, state, axes=1))
            self.last = self.x
            self.x, self.v, _ = np.tensordot(self.over, state, axes=1)
        self.command = command
        return np.concatenate(out) / loop.static_gain


class _Settled:
    def __init__(self, loop, rate_hz, shape):
        pass

    def hold(self, command):
        """Return the positions (STEPS, runs, m) while a command holds."""
        return np.broadcast_to(command, (STEPS, *command.shape))


def image_residuals(hardware, controller, phase, noise, frames, *, sensor_gain=1.0):
    """Yield the residual (STEPS, runs, n) in each frame of a loop that starts at rest.

    ``phase(t)`` is the phase (STEPS, runs, n) at times t in frames, ``noise`` (runs, q) that of the
    first reading.
    """
    k, m = controller, hardware.n_commands
    runs = len(noise)
    kind = _Settled if hardware.mirror is None else _Shell
    mirror = kind(hardware.mirror, hardware.frame_rate_hz, (runs, m))
    late = round((hardware.delay_frames - 1) * STEPS)
    assert abs(late - (hardware.delay_frames - 1) * STEPS) < 1e-9
    ahead = np.zeros((late + STEPS, runs, m), dtype=complex)  # positions from this frame on
    state, seen = np.zeros((runs, k.n_states), dtype=complex), np.zeros((runs, hardware.modes))
    for frame in range(frames):
        y = sensor_gain * seen @ hardware.sensor.T + (noise if frame == 0 else 0)
        state = state @ k.A.T + y @ k.B.T
        ahead[late:] = mirror.hold(state @ k.C.T + y @ k.D.T)
        times = frame + (np.arange(STEPS) + 0.5) / STEPS
        residual = phase(times) - ahead[:STEPS] @ hardware.influence.T
        seen = residual.mean(axis=0)
        ahead = np.concatenate([ahead[STEPS:], np.zeros((STEPS, runs, m))])
        yield residual


def sinusoid_powers(hardware, controller, frequency_hz, along, *, frames=300, sensor_gain=1.0):
    """Return what sinusoids of unit power leave in the image, (f, n, n), one by one."""
    turns = 2j * np.pi * np.asarray(frequency_hz) / hardware.frame_rate_hz

    def phase(times):
        return np.exp(turns * times[:, None])[..., None] * np.asarray(along)

    noise = np.zeros((len(turns), hardware.n_measurements))
    for residual in image_residuals(
        hardware, controller, phase, noise, frames, sensor_gain=sensor_gain
    ):
        last = residual  # of a complex wave: its power repeats with the frame
    return np.real(np.einsum("tfi,tfj->fij", last, last.conj())) / STEPS


def noise_covariance(hardware, controller, noise_nm, *, frames=300, sensor_gain=1.0):
    """Return what white noise (q,) leaves in the image, (n, n): of impulses, one by one."""
    total, n = 0.0, hardware.modes
    for residual in image_residuals(
        hardware,
        controller,
        lambda t: np.zeros((STEPS, 1, n)),
        np.diag(noise_nm),
        frames,
        sensor_gain=sensor_gain,
    ):
        total = total + np.real(np.einsum("tfi,tfj->ij", residual, residual.conj())) / STEPS
    return total


def power_of_two_sensors(plant, controller, frequency_hz, along, *, frames=480):
    """Return what a sinusoid of unit power leaves in the image, (n, n), of a settled mirror.

    Beside its own sensor the loop reads one slower wavefront sensor. The mean is over 16 frames.
    """
    hardware, (slow,) = plant.hardware, plant.hardware.suite.wavefront
    n, rows, rate = hardware.modes, hardware.suite.rows(hardware), hardware.frame_rate_hz
    age, period = age_frames(hardware, slow), frames_per_reading(hardware, slow)
    late = round((hardware.delay_frames - 1) * STEPS)
    position = np.zeros(((frames + 8) * STEPS, n), dtype=complex)
    means, state = np.zeros((frames, n), dtype=complex), np.zeros(controller.n_states)
    power = np.zeros((n, n))
    for k in range(frames):
        y = np.zeros(hardware.n_readings, dtype=complex)
        y[rows["wavefront"]] = hardware.sensor @ held_mean(means, k, 1, 1)
        if k % period == 0:
            y[rows[slow.name]] = slow.sensor_matrix @ held_mean(means, k, age, period)
        A, B, C, D = (stack[k % controller.period] for stack in controller.stacks())
        state = A @ state + B @ y
        begin = k * STEPS + late
        position[begin : begin + STEPS] = hardware.influence @ (C @ state + D @ y)
        times = k + (np.arange(STEPS) + 0.5) / STEPS
        wave = np.exp(2j * np.pi * frequency_hz / rate * times)[:, None] * np.asarray(along)
        residual = wave - position[k * STEPS : (k + 1) * STEPS]
        means[k] = residual.mean(axis=0)
        if k >= frames - 16:
            power += np.real(residual.T @ residual.conj()) / STEPS / 16
    return power


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


class Broad:
    """A smooth spectrum of no model."""

    def psd(self, frequency_hz):
        return 30 / (1 + (np.asarray(frequency_hz) / 40) ** 2)


def sinusoid(frequency_hz, rms_nm, direction=(1, 0)):
    return lbt.models.SinusoidalVibration(
        frequency_hz=frequency_hz, rms_nm=rms_nm, direction=direction
    )


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


def closed(plant, **facts):
    """Return the controller of the Kalman filter, and its loop."""
    controller = plant.controller(kalman_riccati(plant).gain_predictor)
    return controller, lbt.close_loop(plant.hardware, controller, **facts)


@pytest.mark.parametrize(
    ("changes", "loop"),
    [
        ({}, {}),
        ({}, {"sensor_gain": 0.6}),
        ({}, {"blind": ("truth", "m1")}),
        ({"delay_frames": 1.5, "turbulence": AR3}, {}),
        ({"delay_frames": 3, "sensors": (HALF, OTHER)}, {}),
        ({"sensors": (SLEEPY,)}, {}),
        ({"sensors": (THIRD, SELDOM), "lines": SHAKES[:1], "motions": MOTIONS[:1]}, {}),
        ({"mirror": SHELL, "influence_matrix": [[2.0, 0.1], [0.3, 1.0]]}, {}),
        ({"sensor_matrix": [[1, 0], [0, 1], [0.5, 0.5]], "noise_nm": [30, 30, 40]}, {}),
    ],
)
def test_budgets_are_what_impulses_leave(changes, loop):
    plant = example_plant(**changes)
    controller, own = closed(plant, **loop)
    budget = residual_budget(own, plant, frame_means=True)
    if not loop and changes.keys().isdisjoint(
        ("mirror", "turbulence")
    ):  # the residual of the model is the error of the filter
        P = kalman_riccati(plant).P.reshape(-1, plant.n_states, plant.n_states)
        rms = np.sqrt(np.mean([np.trace(plant.L @ one @ plant.L.T) for one in P]))
        assert budget.rms_nm == pytest.approx(rms, rel=1e-9)
    exact = budget.turbulence_nm2, budget.random_vibration_nm2, budget.noise_nm2
    for one, simulated in zip(exact, simulated_covariances(plant, controller, **loop), strict=True):
        assert np.abs(one - simulated).max() < 1e-8 * np.trace(one)


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


def a_shell(**changes):
    facts = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 150}
    return PositionLoop.from_bandwidth(**(facts | {"sampling_hz": 8000.0} | changes))


MIRRORS = {"settled": None, "shell": a_shell(), "ramp": a_shell(ramp_samples=4, delay_samples=0)}


@pytest.mark.parametrize(
    ("mirror", "delay"), [("settled", 1), ("settled", 2.49), ("shell", 2.9), ("ramp", 3)]
)
def test_the_image_has_what_a_run_in_small_steps_leaves(mirror, delay):
    path = lbt.LoopHardware(
        frame_rate_hz=800,
        delay_frames=delay,
        sensor_matrix=[[1.0, 0.2], [-0.1, 0.7], [0.3, 0.3]],
        influence_matrix=[[1.0, 0.1], [0.3, 0.8]],
        mirror=MIRRORS[mirror],
    )
    B = 0.2 * np.linalg.pinv(path.sensor @ path.influence) + [[0, 0.05, 0], [0.02, 0, 0]]
    controller = lbt.Controller(A=np.eye(2), B=B, C=np.eye(2), D=np.zeros((2, 3)), dt_s=1 / 800)
    loop = lbt.close_loop(path, controller, sensor_gain=0.8)
    along, hertz, noise_nm = np.array([0.6, 0.8]), [3.0, 62.0, 390.0], [5.0, 9.0, 15.0]
    facts = {"frames": 150, "sensor_gain": 0.8}
    waves = 100**2 * sinusoid_powers(path, controller, hertz, along, **facts)
    white = noise_covariance(path, controller, noise_nm, **facts)
    lines = tuple(sinusoid(f, 100.0, tuple(along)) for f in hertz)
    for shaken, noise, expected in (
        *(((line,), 0.0, wave) for line, wave in zip(lines, waves, strict=True)),
        ((), noise_nm, white),
        (lines, noise_nm, waves.sum(axis=0) + white),
    ):
        truth = Truth(turbulence=None, vibrations=shaken, noise_nm=noise, sensor_gain=0.8)
        budget = lbt.residual_budget(loop, truth)
        assert np.abs(budget.total_nm2 - expected).max() < 1e-4 * np.trace(expected)
        if mirror == "settled":
            within = sum(
                line.rms_nm**2 * (1 - np.sinc(line.frequency_hz / 800) ** 2) for line in shaken
            )
            assert np.trace(budget.within_nm2) == pytest.approx(within, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("delay", [2, 2.49])
def test_a_loop_of_two_sensors_has_what_a_run_in_small_steps_leaves(delay):
    plant = example_plant((OTHER,), delay_frames=delay)
    controller, loop = closed(plant)
    truth = Truth(turbulence=None, vibrations=(sinusoid(62.5, 100, (3, 4)),))
    budget = lbt.residual_budget(loop, truth)
    expected = 100**2 * power_of_two_sensors(plant, controller, 62.5, (0.6, 0.8))
    np.testing.assert_allclose(budget.vibration_nm2 + budget.within_nm2, expected, rtol=1e-5)


@pytest.mark.parametrize("changes", [{"delay_frames": 2.49}, {"mirror": SHELL}])
def test_a_line_that_channels_hardly_see_is_one_that_they_do_not(changes):
    """One is a sampled oscillator, the other an autoregressive process: alike with no damping."""
    line = lbt.Vibration(frequency_hz=60, damping=1e-5, rms_nm=300, direction=(3, 4))
    _, loop = closed(example_plant((FAST,), **changes))
    seen, unseen = (
        lbt.residual_budget(loop, Truth(turbulence=None, vibrations=(line,), motions=(motion,)))
        for motion in ({"m1": Motion(size=1e-9)}, {})
    )
    np.testing.assert_allclose(seen.random_vibration_nm2, unseen.random_vibration_nm2, rtol=1e-4)
    np.testing.assert_allclose(seen.within_nm2, unseen.within_nm2, rtol=1e-4)


PATH = lbt.LoopHardware(frame_rate_hz=800)
LAZY = lbt.integrator(PATH, gain=0.3).controller
LOOP = lbt.close_loop(PATH, LAZY)
WILD = lbt.Controller(A=np.eye(2), B=3 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=1 / 800)
OTHER_RATE = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=1, frame_rate_hz=100)
DRIFTING = lbt.models.SinusoidalVibration(frequency_hz=20, end_hz=30, duration_s=1, rms_nm=100)


class Odd:
    """A density that is none."""

    def psd(self, frequency_hz):
        return np.full(np.shape(frequency_hz), -1.0)


ODD, FEW = Truth(turbulence=Odd(), noise_nm=1.0), closed(example_plant((FAST,)))[0]


def gained(sensor_gain):
    return closed(example_plant(), sensor_gain=sensor_gain)[1]


def met(*lines, turbulence=None, loop=LOOP, **facts):
    """Ask for the residual of a loop."""
    return lbt.residual_budget(loop, Truth(turbulence=turbulence, vibrations=lines, **facts))


def test_refusals():
    rows = [
        (
            lambda: lbt.close_loop(lbt.LoopHardware(frame_rate_hz=800, modes=1), LAZY),
            DimensionError,
            "got 2 to 2",
        ),
        (lambda: lbt.close_loop(replace(PATH, frame_rate_hz=500), LAZY), ProblemError, "for 800"),
        (lambda: met(sensor_gain=0.5), ProblemError, "truth's sensor gain 0.5; got 1"),
        (lambda: met(sinusoid(10, 1, (1, 0, 0))), DimensionError, "must have 2 components"),
        (lambda: met(sinusoid(600, 1)), ProblemError, "below the Nyquist"),
        (lambda: met(turbulence=OTHER_RATE), ProblemError, "sampled at the loop's 800 Hz"),
        (lambda: met(DRIFTING), ProblemError, "stationary"),
        (lambda: met(turbulence=Odd()), ProblemError, "one finite number of at least 0"),
        (lambda: lbt.loop.least_residual(PATH, ODD), ProblemError, "finite number of at least 0"),
        (lambda: met(loop=lbt.close_loop(PATH, WILD)), UnstableLoopError, "an unstable one"),
        (lambda: met(loop=gained(8.0), sensor_gain=8.0), UnstableLoopError, "at sensor gain 8"),
        (lambda: lbt.residual_budget(LOOP, PATH), ProblemError, "expected a Truth"),
        (lambda: met(loop=LOOP.system), ProblemError, "must be a ClosedLoop"),
        (lambda: closed(example_plant(), blind=("m9",)), ProblemError, "is called 'm9'"),
        (lambda: lbt.close_loop(example_plant().hardware, FEW), ProblemError, "in a period of 4"),
        (lambda: gained(0.0), ProblemError, "sensor_gain"),
    ]
    require_refusals(rows)


RATE = 500.0
DRIFT = lbt.models.ARModel(coefficients=[0.98], driving_rms_nm=5.0, frame_rate_hz=RATE)
AIR = lbt.Atmosphere(seeing_arcsec=0.8, outer_scale_m=22, wind_speed_m_s=20, diameter_m=8.22)
TURNED = lbt.models.SinusoidalVibration(frequency_hz=20.04, rms_nm=300, direction=(0.6, 0.8))
THIN = lbt.Vibration(frequency_hz=33.3, damping=0.001, rms_nm=50, direction=(0.8, -0.6))


@pytest.mark.parametrize("air", [None, AIR, DRIFT], ids=["noise", "spectrum", "process"])
@pytest.mark.parametrize(
    "mirror",
    [
        {},
        {"delay_frames": 2.4},
        {
            "mirror": PositionLoop.from_bandwidth(
                natural_frequency_hz=50, damping=0.5, bandwidth_hz=300, sampling_hz=24_000
            )
        },
    ],
    ids=["settled", "fraction", "dynamics"],
)
def test_the_sums_of_the_spectrum_are_the_exact_residual(air, mirror):
    """By frequencies, what the budget has from covariances."""
    path = lbt.LoopHardware(frame_rate_hz=RATE, **mirror)
    truth = Truth(turbulence=air, noise_nm=(15.5, 8.0), vibrations=(TURNED, THIN))
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    frequency_hz, density = residual_spectrum(loop, truth, 0.2)
    exact = np.diag(residual_budget(loop, truth).total_nm2)
    assert density.sum(axis=0) * 0.2 == pytest.approx(exact, rel=1e-6)
    assert frequency_hz[[0, -1]] == pytest.approx([0.2, RATE / 2])
    quiet = replace(truth, vibrations=(THIN,))
    of_line = density - residual_spectrum(loop, quiet, 0.2)[1]
    place = np.argmin(np.abs(frequency_hz - 20.04))
    assert np.flatnonzero(np.any(of_line > 1e-9 * of_line.max(), axis=1)).tolist() == [place]
    assert of_line[place, 1] / of_line[place, 0] == pytest.approx((0.8 / 0.6) ** 2)


def test_the_spectrum_of_noise_through_an_integrator():
    """``g / (z - 1 + g)`` of white noise, whose spectrum changes little within a step."""
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=1, modes=1)
    lazy = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    truth = Truth(turbulence=None, noise_nm=3.0)
    frequency_hz, density = residual_spectrum(lbt.close_loop(path, lazy), truth, 0.2)
    gain = np.abs(0.5 / (np.exp(2j * np.pi * frequency_hz / 800) - 0.5)) ** 2
    # the ends take in half a step more and less
    assert density[1:-1, 0] == pytest.approx(2 * 9 / 800 * gain[1:-1], rel=1e-5)
    assert density[[0, -1], 0] == pytest.approx(2 * 9 / 800 * gain[[0, -1]] * [1.5, 0.5], rel=1e-4)


def test_loops_that_have_no_spectrum():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    wild = lbt.Controller(A=1.0, B=3.0, C=1.0, D=0.0, dt_s=1 / 800)
    truth = Truth(turbulence=None, noise_nm=3.0)
    with pytest.raises(UnstableLoopError):
        residual_spectrum(lbt.close_loop(path, wild), truth, 0.2)
    drift = replace(TURNED, direction=(1,), end_hz=21.0, duration_s=10.0)
    still = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    with pytest.raises(ProblemError, match="a truth that is stationary"):
        residual_spectrum(still, replace(truth, vibrations=(drift,)), 0.2)
    plant = example_plant()
    loop = lbt.kalman(plant).close(plant.hardware)
    with pytest.raises(ProblemError, match="a loop that reads its own sensor alone"):
        residual_spectrum(loop, plant, 0.2)
