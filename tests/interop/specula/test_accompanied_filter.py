"""Filters of several sensors in an end-to-end simulation."""

from dataclasses import replace

import numpy as np
import pytest
from support.sensor_loops import sinusoid_reading
from support.small_telescope import BRIGHT, PATH, SETUP, needs_specula

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.interop.specula.accompanied_filter import AccompaniedFilter, accompany_filter
from lbt_synth.linear import Controller
from lbt_synth.loop.simulation.disturbances import draw_disturbance
from lbt_synth.models import Accelerometer, Motion, SensorSuite, WavefrontSensor

LENGTH = {"frames": 1600, "settle_frames": 400, "seed": 2}
# faint enough that the noise of the pyramid decides, as it does of a dim star
DIM = replace(BRIGHT, photons=30.0, read_noise_electrons=4.0)
SHAKES = (
    lbt.models.SinusoidalVibration(frequency_hz=42, rms_nm=60.0, direction=(1, 0)),
    lbt.models.SinusoidalVibration(frequency_hz=57, rms_nm=40.0, direction=(0.6, 0.8)),
)
MOTIONS = (
    {"m1": Motion(size=2.0)},
    {"m1": Motion(size=0.5, phase_deg=90), "m2": Motion(size=1.0, phase_deg=170)},
)
MIRROR = Accelerometer(
    name="mirror", rate_hz=800, delay_frames=1.3, channels=("m1", "m2"), noise_m_s2=5e-4
)
TRUTH_SENSOR = WavefrontSensor(name="truth", rate_hz=200, delay_frames=2, noise_nm=5.0)
SETTINGS = replace(
    SETUP, system=DIM, vibrations=SHAKES, motions=MOTIONS, leak_from_mode=2, leak=0.99, **LENGTH
)


def dim_filter(*sensors, modes=2, noise_nm=15.0, **changes):
    """A Kalman filter of the small telescope's loop and of its accelerometer."""
    lines = [
        lbt.Vibration(
            frequency_hz=shake.frequency_hz,
            damping=0.005,
            rms_nm=shake.rms_nm,
            direction=shake.direction[:modes] if modes == 2 else (1,),
        )
        for shake in SHAKES
    ]
    own = lbt.tip_tilt_plant(
        frame_rate_hz=800,
        turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=0.5, frame_rate_hz=800),
        noise_nm=noise_nm,
        vibrations=lines,
        modes=modes,
        **changes,
    )
    suite = SensorSuite(sensors=sensors or (MIRROR,))
    motions = MOTIONS if suite.channels else ()
    return lbt.kalman(own.with_sensors(suite, motions))


@pytest.fixture(scope="module")
def shaking():
    return dim_filter()


def test_channels_follow_the_motions_that_shake_the_telescope():
    quiet = dim_filter(replace(MIRROR, noise_m_s2=1e-7))
    shaken = lbt.Truth(turbulence=None, vibrations=SHAKES, motions=MOTIONS)
    own = accompany_filter(quiet, shaken, **LENGTH)
    tilts = draw_disturbance(
        shaken, PATH, frames=2000, cases=1, rng=np.random.default_rng(2), zero_frame=400
    )[0]
    # the second line alone has a part along tilt
    second = tilts[:, 1] / 0.8
    moved = {0: tilts[:, 0] - 0.6 * second, 1: second}
    for column, channel in enumerate(("m1", "m2")):
        expected = sum(
            sinusoid_reading(
                PATH, MIRROR, MOTIONS[line][channel], SHAKES[line].frequency_hz, motion
            )
            for line, motion in moved.items()
            if channel in MOTIONS[line]
        )
        np.testing.assert_allclose(own.others[5:-1, column], expected[5:-1], atol=1e-6)


def test_steps_are_those_of_the_filter_of_all_readings():
    rng = np.random.default_rng(0)
    parts = {"A": (2, 3, 3), "B": (2, 3, 3), "C": (2, 2, 3), "D": (2, 2, 3)}
    controller = Controller(**{n: rng.standard_normal(s) for n, s in parts.items()})
    others = rng.standard_normal((4, 1))
    own = AccompaniedFilter(controller=controller, others=others, hardware=PATH)
    y = rng.standard_normal((4, 2))
    x, expected = np.zeros(3), []
    for k in range(4):
        measured = np.append(y[k], others[k])
        x = controller.A[k % 2] @ x + controller.B[k % 2] @ measured
        expected.append(controller.C[k % 2] @ x + controller.D[k % 2] @ measured)
    for _ in range(2):
        np.testing.assert_allclose([own.step(each) for each in y], expected, rtol=1e-12)
        with pytest.raises(ProblemError, match="readings for 4 frames"):
            own.step(y[0])
        own.reset()


def test_a_further_wavefront_sensor_is_not_read(shaking):
    both = dim_filter(TRUTH_SENSOR, MIRROR)
    shaken = lbt.Truth(turbulence=None, vibrations=SHAKES, motions=MOTIONS)
    with_truth = accompany_filter(both, shaken, **LENGTH)
    without = accompany_filter(shaking, shaken, **LENGTH)
    rows = both.problem.hardware.suite.rows(PATH)
    assert not with_truth.controller.B[:, :, rows["truth"]].any()
    y = np.random.default_rng(1).standard_normal((200, 2))
    # the readings have other noise: only the wavefront's part is compared
    still = [replace(each, others=0 * each.others) for each in (with_truth, without)]
    steps = [np.array([each.step(one) for one in y]) for each in still]
    np.testing.assert_allclose(steps[0], steps[1], rtol=1e-6, atol=1e-9)


def test_filters_that_do_not_fit_are_refused(shaking):
    with pytest.raises(ProblemError, match=r"moves a channel of the design \(m1, m2\)"):
        replace(SETTINGS, motions=({}, {})).controller(shaking)
    with pytest.raises(DimensionError, match="two measurements .* got 1 to 1"):
        SETTINGS.controller(dim_filter(TRUTH_SENSOR, modes=1))
    with pytest.raises(ProblemError, match="800 Hz and 2.5 frames"):
        SETTINGS.controller(dim_filter(replace(MIRROR, delay_frames=2), delay_frames=2.5))


@needs_specula
def test_with_accelerometers_a_dim_star_leaves_less_as_predicted(shaking, cache):
    """All sensors against the wavefront only, each as the exact analysis says of the pyramid's noise."""
    found, expected = {}, {}
    for name, design in (
        ("all", shaking),
        ("alone", lbt.kalman(shaking.problem.own_sensor_alone())),
    ):
        run = SETTINGS.run(design, cache=cache)
        truth = lbt.Truth(
            turbulence=None,
            vibrations=SHAKES,
            motions=MOTIONS,
            noise_nm=run.tip_tilt_noise_nm,
            sensor_gain=run.tip_tilt_gain,
        )
        loop = design.close(PATH, sensor_gain=run.tip_tilt_gain)
        found[name] = np.hypot(*run.rms_nm[:2])
        expected[name] = lbt.residual_budget(loop, truth).rms_nm
    for name, value in found.items():
        assert value == pytest.approx(expected[name], rel=0.1)
    assert found["all"] < 0.7 * found["alone"]
