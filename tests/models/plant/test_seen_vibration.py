"""Vibrations that accelerometers see, against oscillators that are kicked within each frame."""

from functools import partial

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov
from support.oscillators import KickedOscillator

import lbt_synth as lbt
from lbt_synth.models import Accelerometer, LoopHardware, Motion
from lbt_synth.models.plant.seen_vibration import seen_vibration

RATE_HZ, LAGS = 800.0, 4
PATH = LoopHardware(frame_rate_hz=RATE_HZ, delay_frames=2, modes=1)
RMS_NM, NOISE_NM = 563.6, 77.5
# almost none: 3e-9 of the least residual's power
AIR = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=2e-4, frame_rate_hz=RATE_HZ)
reading = {"rate_hz": RATE_HZ, "delay_frames": 1, "noise_m_s2": 1e-3}
mirror = partial(Accelerometer, name="mirror", channels=("a", "v"), **reading)
shake = partial(lbt.Vibration, frequency_hz=60, damping=0.05, rms_nm=RMS_NM, direction=(1.0,))


def lag_covariances(A, B, C):
    """Return the covariances of y(k + lag) and y(k) of a system without periods."""
    P = solve_discrete_lyapunov(A, B @ B.T)
    return np.array([C @ np.linalg.matrix_power(A, lag) @ P @ C.T for lag in range(LAGS)])


@pytest.mark.parametrize(
    ("frequency_hz", "damping", "share"), [(5, 1e-3, 0.25), (60, 0.05, 1.0), (390, 0.9, 0.25)]
)
def test_exact_sampling_has_the_covariances_of_256_kicks_a_frame(frequency_hz, damping, share):
    line = shake(frequency_hz=frequency_hz, damping=damping)
    motion = {"a": Motion(size=1), "v": Motion(size=1, phase_deg=90)}
    seen = seen_vibration(line, motion, (mirror(delay_frames=2 - share),), PATH)
    w = 2 * np.pi * frequency_hz
    units = 1.0, -1e-9 * w**2, -1e-9 * w**2  # the readings are about -w^2 times positions
    sampled = lag_covariances(seen.A, seen.B, seen.C / np.array(units)[:, None])
    A, B = KickedOscillator(w / RATE_HZ, damping, RMS_NM).chain(share, 2)
    C = np.zeros((3, len(A)))
    C[0, 2] = 1.0
    C[1, [5, 7]] = np.array([-1, 1]) * RATE_HZ / w  # less the mean acceleration over w^2
    C[2, [4, 6]] = np.array([1, -1]) * RATE_HZ / w  # the mean velocity over w
    expected = lag_covariances(A, B, C)
    P = seen_vibration(line, {}, (), PATH).covariances()[0]
    np.testing.assert_allclose(P[1:, 1:], RMS_NM**2 * np.eye(2), rtol=1e-12, atol=1e-6)
    sizes = np.sqrt(np.diag(expected[0]))
    assert np.abs((sampled - expected) / np.outer(sizes, sizes)).max() < 1e-9
    assert sizes[0] < RMS_NM


@pytest.mark.parametrize(
    ("period", "age", "ahead"), [(1, 0.0, 0), (1, 0.3, 1), (1, 2.0, 3), (2, 1.0, 1), (4, 9.25, 3)]
)
def test_a_line_that_hardly_decays_is_read_as_a_sinusoid(period, age, ahead):
    """In size and phase: its readings over its mean positions, as it turns freely."""
    sensor = mirror(rate_hz=RATE_HZ / period, delay_frames=(age + 1) / period, highpass_hz=20.0)
    motion = {"a": Motion(size=2, phase_deg=-30), "v": Motion(size=0.5, phase_deg=110)}
    line = shake(frequency_hz=77, damping=1e-9, rms_nm=1)
    seen = seen_vibration(line, motion, (sensor,), PATH, ahead=ahead)
    turn = 2j * np.pi * 77 / RATE_HZ
    # the free motion from frame to frame; after some frames the memory is filled
    state = seen.still @ np.array([1.0, 1.0j])
    for t in range(30 * seen.period):
        state = seen.stacks()[0][t % seen.period] @ state
    position, *readings = seen.stacks()[2][0] @ state
    late = np.mean(np.exp(-turn * (age + 1 - period + np.arange(period))))  # over the exposure
    acceleration = -1e-9 * (2 * np.pi * 77) ** 2 * late / (1 - 20j / 77)
    expected = [motion[name].factor * acceleration for name in ("a", "v")]
    swings = [sensor.swing(motion[name], 77.0, PATH) for name in ("a", "v")]
    np.testing.assert_allclose(swings, expected, rtol=1e-12)
    ratios = np.array(readings) / (position * np.exp(-turn * ahead))
    np.testing.assert_allclose(ratios, expected, rtol=1e-6)


def test_a_reading_knows_nothing_of_the_frame_to_come():
    seen = seen_vibration(shake(), {"a": Motion(size=1)}, (mirror(),), PATH)
    assert not seen.D.any()
    # of the drive of its own frame it has what the velocity at the end has
    w = 2 * np.pi * 60
    np.testing.assert_allclose((seen.C @ seen.B)[1], 1e-9 * w * RATE_HZ * seen.B[2], rtol=1e-12)


def test_channels_that_move_alike_share_their_memory():
    for phase_deg, states in ((180, 4), (90, 5)):
        motion = {"a": Motion(size=1), "v": Motion(size=0.3, phase_deg=phase_deg)}
        assert seen_vibration(shake(), motion, (mirror(),), PATH).n_states == states


# Filters of wavefront and accelerometer against the limit of the continuous oscillator: that of a
# Kalman filter of an oscillator that is kicked within each frame, and what the loop leaves of it.
# Neither comes from the package.
def designed(frequency_hz, damping, noise, age):
    """Return the Kalman filter of a loop of two frames; the noise is over w^2 times the rms."""
    line = shake(frequency_hz=frequency_hz, damping=damping)
    facts = {"turbulence": AIR, "vibrations": [line], "noise_nm": NOISE_NM, "modes": 1}
    noise_m_s2 = 1e-9 * noise * (2 * np.pi * frequency_hz) ** 2 * RMS_NM
    channel = mirror(delay_frames=1 + age, channels=("m1",), noise_m_s2=noise_m_s2)
    plant = lbt.tip_tilt_plant(frame_rate_hz=RATE_HZ, **facts)
    suite = lbt.models.SensorSuite(sensors=(channel,))
    return lbt.kalman(plant.with_sensors(suite, ({"m1": Motion(size=1)},)))


def least_nm(frequency_hz, damping, noise, age):
    """Return what any linear filter leaves of the position that the next command meets."""
    angle, frames = 2 * np.pi * frequency_hz / RATE_HZ, int(age)
    A, B = KickedOscillator(angle, damping, RMS_NM, steps=8).chain(1 - age + frames, frames + 2)
    C = np.zeros((2, len(A)))
    C[0, 3] = 1.0  # the mean position in the frame before
    C[1, [5 + 2 * frames, 7 + 2 * frames]] = np.array([1, -1]) / angle  # over 1e-9 w^2
    R = np.diag([NOISE_NM, noise * RMS_NM]) ** 2
    return float(np.sqrt(solve_discrete_are(A.T, C.T, B @ B.T, R)[2, 2]))


@pytest.mark.parametrize("seed", range(12))
def test_a_certified_residual_is_the_least_that_physics_allows(seed):
    """The AR2 process whose second difference was read left 39 nm of 55.6 nm."""
    rng = np.random.default_rng([seed, 7])
    damping, noise = np.exp(rng.uniform(np.log(1e-3), np.log(0.1), 2)).tolist()
    case = float(rng.uniform(5, 200)), damping, noise, [0.0, 0.0, 0.375, 1.25][seed % 4]
    design = designed(*case)
    assert design.certificate.passed
    assert design.rms == pytest.approx(least_nm(*case), rel=1e-6)
