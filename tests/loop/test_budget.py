"""The exact residual of a loop against closed forms, brute force and runs of the loop."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import expm
from support import predictions, sensor_loops
from support.ensembles import AIR
from support.limits import Anonymous
from support.plants import lbt_axis_plant
from support.refusals import require_refusals
from support.sensor_loops import FAST, MOTIONS, RATE_HZ, SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError, UnstableLoopError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.budget import residual_budget, residual_spectrum
from lbt_synth.loop.closed_loop import youla_controller
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


def image_residuals(hardware, controller, phase, noise, frames, *, sensor_gain=1.0):
    """Yield the residual (STEPS, runs, n) in each frame of a loop that starts at rest.

    ``phase(t)`` is the phase (STEPS, runs, n) at times t in frames, ``noise`` (runs, q) that of the
    first reading. Beside its own sensor the loop may read slower wavefront sensors.
    """
    runs, m, n = len(noise), hardware.n_commands, hardware.modes
    moving = hardware.mirror and _Shell(hardware.mirror, hardware.frame_rate_hz, (runs, m))
    late = round((hardware.delay_frames - 1) * STEPS)
    assert abs(late - (hardware.delay_frames - 1) * STEPS) < 1e-9
    ahead = np.zeros((late + STEPS, runs, m), dtype=complex)  # positions from this frame on
    state, means = np.zeros((runs, controller.n_states)), np.zeros((frames, runs, n), dtype=complex)
    sources = [(sensor_gain * hardware.sensor, 1, 1)]
    for sensor in hardware.suite.wavefront:
        times = sensor_loops.age_frames, sensor_loops.frames_per_reading
        sources.append((sensor.sensor_matrix, *(time(hardware, sensor) for time in times)))
    for k in range(frames):
        readings = [
            sensor_loops.held_mean(means, k, age, period) @ response.T * (k % period == 0)
            for response, age, period in sources
        ]
        y = np.hstack(readings) + (noise if k == 0 else 0)
        A, B, C, D = (stack[k % controller.period] for stack in controller.stacks())
        state = state @ A.T + y @ B.T
        command = state @ C.T + y @ D.T
        ahead[late:] = moving.hold(command) if moving else command
        times = k + (np.arange(STEPS) + 0.5) / STEPS
        residual = phase(times) - ahead[:STEPS] @ hardware.influence.T
        means[k] = residual.mean(axis=0)
        ahead = np.concatenate([ahead[STEPS:], np.zeros((STEPS, runs, m))])
        yield residual


def image_powers(hardware, controller, hertz, along, noise_nm=(), *, frames=150, **loop):
    """Return what sinusoids of unit power leave in the image, (f, n, n), and noise, (n, n).

    The sinusoids run one by one, to the mean over the last 16 frames; the white noise (q,) is a
    sum over impulses.
    """
    turns = 2j * np.pi * np.asarray(hertz) / hardware.frame_rate_hz
    noise = np.diag(noise_nm).reshape(-1, hardware.n_readings)

    def phase(times):
        waves = np.exp(turns * times[:, None])[..., None] * np.asarray(along)
        return np.concatenate([waves, np.zeros((STEPS, len(noise), len(along)))], axis=1)

    readings = np.vstack([np.zeros((len(turns), hardware.n_readings)), noise])
    runs = image_residuals(hardware, controller, phase, readings, frames, **loop)
    powers = np.real([np.einsum("tfi,tfj->fij", x, x.conj()) / STEPS for x in runs])
    return powers[-16:, : len(turns)].mean(axis=0), powers[:, len(turns) :].sum(axis=(0, 1))


def channels(name, period, delay_frames, names=("m1", "m2"), **filtered):
    facts = {"rate_hz": RATE_HZ / period, "delay_frames": delay_frames, "noise_m_s2": 2e-3}
    return Accelerometer(name=name, channels=names, **facts, **filtered)


ONE_LINE = {"lines": sensor_loops.LINES[:1], "motions": MOTIONS[:1]}
SELDOM = WavefrontSensor(name="seldom", rate_hz=50, delay_frames=1.3, noise_nm=4)
SHELL = PositionLoop.from_bandwidth(natural_frequency_hz=50, damping=0.5, bandwidth_hz=500)
AR3 = lbt.models.ARModel(coefficients=[1.2, -0.3, -0.05], driving_rms_nm=20, frame_rate_hz=RATE_HZ)


def sinusoid(frequency_hz, rms_nm, direction=(1, 0)):
    facts = {"frequency_hz": frequency_hz, "rms_nm": rms_nm, "direction": direction}
    return lbt.models.SinusoidalVibration(**facts)


def test_a_measured_spectrum_against_brute_force():
    rng = np.random.default_rng(0)
    f = np.linspace(5, 100, 3393)
    lines = sum(40 / (1 + ((f - c) / w) ** 2) for c, w in ((10, 0.1), (48.3, 0.03), (72.5, 0.05)))
    density = lines * rng.uniform(0.2, 1, f.size)
    table = lbt.models.TabulatedSpectrum(frequency_hz=f, density_nm2_hz=density)
    plant = lbt_axis_plant()
    loop = lbt.close_loop(plant.hardware, lbt.integrator(plant.hardware, gain=0.4).controller)
    # a triangle of unit area leaves the rejection at its place
    ends, density = [37.297, 37.3, 37.303], [0, 100 / 0.003, 0]
    narrow = lbt.models.TabulatedSpectrum(frequency_hz=ends, density_nm2_hz=density)
    left = abs(loop.sensitivity([37.3])[0, 0, 0]) * np.sinc(37.3 / 800)
    line = lbt.residual_budget(loop, Truth(turbulence=narrow))
    assert line.turbulence_nm == pytest.approx(10 * left, rel=1e-3)
    fine = np.linspace(5, 100, 3392 * 20 + 1)
    power, share = np.abs(loop.sensitivity(fine)[:, 0, 0]) ** 2, np.sinc(fine / 800) ** 2
    budget = lbt.residual_budget(loop, Truth(turbulence=table))
    powers = budget.turbulence_nm**2, budget.within_nm**2
    expected = [trapezoid(table.psd(fine) * x, fine) for x in (power * share, 1 - share)]
    assert powers == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("delay", "gain", "mirror", "sensor"), predictions.CASES)
def test_the_budget_of_a_model_is_that_of_its_truth(delay, gain, mirror, sensor):
    plant = predictions.a_plant(delay=delay, gain=gain, mirror=mirror, sensor=sensor)
    controller = lbt.integrator(plant.hardware, gain=0.2).controller
    loop = lbt.close_loop(plant.hardware, controller)
    bare = predictions.a_plant(delay=delay, mirror=mirror, sensor=sensor).hardware
    scaled = lbt.close_loop(bare, controller, sensor_gain=gain)
    truths = (predictions.a_truth(), True), (predictions.truth_of_all_moments(), False)
    for truth, frame_means in truths:
        own, other, again = (
            lbt.residual_budget(*pair, frame_means=frame_means)
            for pair in ((loop, plant), (loop, truth), (scaled, plant))
        )
        for name in ("turbulence_nm2", "noise_nm2", "random_vibration_nm2", "total_nm2"):
            expected = getattr(own, name)
            np.testing.assert_allclose(getattr(other, name), expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(again.total_nm2, own.total_nm2, rtol=1e-9, atol=1e-9)


def test_what_is_left_of_strong_slow_lines_keeps_its_digits():
    """It is 1e-5 of the lines; the loop is the optimal one, which leaves the limit."""
    air = lbt.models.ARModel(coefficients=[0.9998], driving_rms_nm=0.01, frame_rate_hz=4000)
    lines = [
        lbt.Vibration(frequency_hz=0.2, damping=1e-3, rms_nm=1000, direction=(1,)),
        lbt.Vibration(frequency_hz=0.1, damping=0.05, rms_nm=300, direction=(1,)),
    ]
    facts = {"turbulence": air, "vibrations": lines, "noise_nm": 0.03}
    plant, truth = lbt.tip_tilt_plant(frame_rate_hz=4000, modes=1, **facts), Truth(**facts)
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
        ({"delay_frames": 3, "sensors": (channels("half", 2, 1.625, ("m2",)), SLOW)}, {}),
        ({"sensors": (channels("sleepy", 3, 2.875),)}, {}),  # exposures wait, and end in a frame
        (ONE_LINE | {"sensors": (channels("third", 3, 1), SELDOM)}, {}),
        ({"mirror": SHELL, "influence_matrix": [[2.0, 0.1], [0.3, 1.0]]}, {}),
        ({"sensor_matrix": [[1, 0], [0, 1], [0.5, 0.5]], "noise_nm": [30, 30, 40]}, {}),
    ],
)
def test_budgets_are_what_impulses_leave(changes, loop):
    plant = example_plant(**changes)
    controller, own = closed(plant, **loop)
    budget = residual_budget(own, plant, frame_means=True)
    # the residual of the model is the error of the filter
    if not loop and changes.keys().isdisjoint(("mirror", "turbulence")):
        P = kalman_riccati(plant).P.reshape(-1, plant.n_states, plant.n_states)
        rms = np.sqrt(np.mean([np.trace(plant.L @ one @ plant.L.T) for one in P]))
        assert budget.rms_nm == pytest.approx(rms, rel=1e-9)
    exact = budget.turbulence_nm2, budget.random_vibration_nm2, budget.noise_nm2
    simulated = sensor_loops.simulated_covariances(plant, controller, **loop)
    for one, other in zip(exact, simulated, strict=True):
        assert np.abs(one - other).max() < 1e-8 * np.trace(one)


@pytest.mark.parametrize(("age", "period"), [(0, 1), (2.4, 2)])
def test_a_sinusoid_leaves_what_a_run_leaves(age, period):
    fast = channels("mirror", period, (1 + age) / period, ("m1",), highpass_hz=5.0)
    plant = example_plant((fast, SLOW), motions=({"m1": MOTIONS[0]["m2"]}, {}))
    controller, loop = closed(plant)
    line = sinusoid(62.5, 200, (3, 4))
    truth = Truth(turbulence=None, vibrations=(line,), motions=plant.motions[:1])
    budget = lbt.residual_budget(loop, truth, frame_means=True)
    wave = 200 * np.sqrt(2) * np.exp(2j * np.pi * 62.5 / RATE_HZ * np.arange(400))
    facts = plant.hardware, fast, MOTIONS[0]["m2"], 62.5
    total, added = np.zeros((400, 2, 2)), np.zeros((400, 2, 5))
    for run, part in enumerate((wave.real, wave.imag)):
        total[:, run] = part[:, None] * np.array([0.6, 0.8])
        added[:, run, 4] = sensor_loops.sinusoid_reading(*facts, part)
    # a period of the line and the sensors
    left = sensor_loops.run_loop(plant, controller, total, added)[-16:]
    covariance = np.einsum("fri,frj->ij", left, left) / 32
    np.testing.assert_allclose(budget.vibration_nm2, covariance, rtol=1e-8)
    # what is left is a sum of sinusoids: the line, and what the period mixes it to
    amplitudes = np.abs(np.fft.fft(left[:, 0] + 1j * left[:, 1], axis=0)) / 16
    strongest = np.sort(np.abs(budget.line_amplitudes_nm), axis=0)
    np.testing.assert_allclose(strongest, np.sort(amplitudes, axis=0)[-4:], rtol=1e-6, atol=1e-6)


def test_a_spectrum_leaves_over_a_period_what_its_process_leaves():
    _, loop = closed(example_plant())
    air = sensor_loops.AIR
    process, spectrum = (
        lbt.residual_budget(loop, Truth(turbulence=[x, None]), frame_means=True).turbulence_nm2
        for x in (air, lbt.models.SumSpectrum(parts=[air]))
    )
    np.testing.assert_allclose(spectrum, process, rtol=1e-5, atol=1e-6)


SLOWLY = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 150, "sampling_hz": 8000.0}
MIRROR = PositionLoop.from_bandwidth(**SLOWLY)
RAMP = PositionLoop.from_bandwidth(**SLOWLY, ramp_samples=4, delay_samples=0)


@pytest.mark.parametrize(("mirror", "delay"), [(None, 1), (None, 2.49), (MIRROR, 2.9), (RAMP, 3)])
def test_the_image_has_what_a_run_in_small_steps_leaves(mirror, delay):
    facts = {"sensor_matrix": [[1.0, 0.2], [-0.1, 0.7], [0.3, 0.3]], "mirror": mirror}
    facts |= {"influence_matrix": [[1.0, 0.1], [0.3, 0.8]], "delay_frames": delay}
    path = lbt.LoopHardware(frame_rate_hz=800, **facts)
    B = 0.2 * np.linalg.pinv(path.sensor @ path.influence) + [[0, 0.05, 0], [0.02, 0, 0]]
    controller = lbt.Controller(A=np.eye(2), B=B, C=np.eye(2), D=np.zeros((2, 3)), dt_s=1 / 800)
    loop = lbt.close_loop(path, controller, sensor_gain=0.8)
    along, hertz, noise_nm = (0.6, 0.8), [3.0, 62.0, 390.0], [5.0, 9.0, 15.0]
    waves, white = image_powers(path, controller, hertz, along, noise_nm, sensor_gain=0.8)
    waves, lines = 100**2 * waves, tuple(sinusoid(f, 100.0, along) for f in hertz)
    for shaken, noise, expected in (
        *(((line,), 0.0, wave) for line, wave in zip(lines, waves, strict=True)),
        ((), noise_nm, white),
        (lines, noise_nm, waves.sum(axis=0) + white),
    ):
        truth = Truth(turbulence=None, vibrations=shaken, noise_nm=noise, sensor_gain=0.8)
        budget = lbt.residual_budget(loop, truth)
        assert np.abs(budget.total_nm2 - expected).max() < 1e-4 * np.trace(expected)
        if mirror is None:
            within = sum(100**2 * (1 - np.sinc(line.frequency_hz / 800) ** 2) for line in shaken)
            assert np.trace(budget.within_nm2) == pytest.approx(within, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("delay", [2, 2.49])
def test_a_loop_of_two_sensors_has_what_a_run_in_small_steps_leaves(delay):
    plant = example_plant((SLOW,), delay_frames=delay)
    controller, loop = closed(plant)
    truth = Truth(turbulence=None, vibrations=(sinusoid(62.5, 100, (3, 4)),))
    budget = lbt.residual_budget(loop, truth)
    (power,), _ = image_powers(plant.hardware, controller, [62.5], (0.6, 0.8), frames=480)
    np.testing.assert_allclose(budget.vibration_nm2 + budget.within_nm2, 1e4 * power, rtol=1e-5)


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
LOOP, SENSORS = lbt.close_loop(PATH, LAZY), example_plant()
WILD = lbt.close_loop(PATH, replace(LAZY, B=10 * LAZY.B))
OTHER_RATE = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=1, frame_rate_hz=100)
DRIFTING = lbt.models.SinusoidalVibration(frequency_hz=20, end_hz=30, duration_s=1, rms_nm=100)
ODD = Truth(turbulence=Anonymous(lambda f: np.full(np.shape(f), -1.0)), noise_nm=1.0)
FEW = closed(example_plant((FAST,)))[0]


def met(*lines, turbulence=None, loop=LOOP, **facts):
    return lbt.residual_budget(loop, Truth(turbulence=turbulence, vibrations=lines, **facts))


def test_refusals():
    single, fast = lbt.LoopHardware(frame_rate_hz=800, modes=1), replace(PATH, frame_rate_hz=500)
    drifting = Truth(turbulence=None, vibrations=(DRIFTING,))
    _, strong = closed(SENSORS, sensor_gain=8)
    rows = [
        (lambda: lbt.close_loop(single, LAZY), DimensionError, "got 2 to 2"),
        (lambda: lbt.close_loop(fast, LAZY), ProblemError, "for 800"),
        (lambda: youla_controller(single, LAZY), DimensionError, "to 1 commands; got 2 to 2"),
        (lambda: met(sensor_gain=0.5), ProblemError, "truth's sensor gain 0.5; got 1"),
        (lambda: met(sinusoid(10, 1, (1, 0, 0))), DimensionError, "must have 2 components"),
        (lambda: met(sinusoid(600, 1)), ProblemError, "below the Nyquist"),
        (lambda: met(turbulence=OTHER_RATE), ProblemError, "sampled at the loop's 800 Hz"),
        (lambda: met(DRIFTING), ProblemError, "stationary"),
        (lambda: lbt.residual_budget(LOOP, ODD), ProblemError, "one finite number of at least 0"),
        (lambda: lbt.loop.least_residual(PATH, ODD), ProblemError, "finite number of at least 0"),
        (lambda: met(loop=WILD), UnstableLoopError, "an unstable one"),
        (lambda: met(loop=strong, sensor_gain=8.0), UnstableLoopError, "at sensor gain 8"),
        (lambda: lbt.residual_budget(LOOP, PATH), ProblemError, "expected a Truth"),
        (lambda: met(loop=LOOP.system), ProblemError, "must be a ClosedLoop"),
        (lambda: closed(SENSORS, blind=("m9",)), ProblemError, "is called 'm9'"),
        (lambda: lbt.close_loop(SENSORS.hardware, FEW), ProblemError, "in a period of 4"),
        (lambda: closed(SENSORS, sensor_gain=0.0), ProblemError, "sensor_gain"),
        (lambda: residual_spectrum(WILD, ODD, 0.2), UnstableLoopError, "unstable"),
        (lambda: residual_spectrum(LOOP, drifting, 0.2), ProblemError, "a truth that is station"),
        (lambda: residual_spectrum(strong, SENSORS, 0.2), ProblemError, "its own sensor alone"),
    ]
    require_refusals(rows)


DRIFT = lbt.models.ARModel(coefficients=[0.98], driving_rms_nm=5.0, frame_rate_hz=500)
TURNED = lbt.models.SinusoidalVibration(frequency_hz=20.04, rms_nm=300, direction=(0.6, 0.8))
MIRRORS = {"settled": {}, "fraction": {"delay_frames": 2.4}, "dynamics": {"mirror": SHELL}}
THIN = lbt.Vibration(frequency_hz=33.3, damping=0.001, rms_nm=50, direction=(0.8, -0.6))


@pytest.mark.parametrize("air", [None, AIR, DRIFT], ids=["noise", "spectrum", "process"])
@pytest.mark.parametrize("mirror", MIRRORS.values(), ids=MIRRORS)
def test_the_sums_of_the_spectrum_are_the_exact_residual(air, mirror):
    """By frequencies, what the budget has from covariances."""
    path = lbt.LoopHardware(frame_rate_hz=500, **mirror)
    truth = Truth(turbulence=air, noise_nm=(15.5, 8.0), vibrations=(TURNED, THIN))
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.3).controller)
    frequency_hz, density = residual_spectrum(loop, truth, 0.2)
    exact = np.diag(residual_budget(loop, truth).total_nm2)
    assert density.sum(axis=0) * 0.2 == pytest.approx(exact, rel=1e-6)
    assert frequency_hz[[0, -1]] == pytest.approx([0.2, 250])
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
