"""A controller in closed loop with SPECULA's optics: a small telescope, seconds per test."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from support.end_to_end import make_run
from support.refusals import require_refusals
from support.sensor_loops import sinusoid_reading
from support.small_telescope import PATH, PLANT, SETUP, SHAKE, needs_specula

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.interop import run_end_to_end
from lbt_synth.interop.specula.simulation import accompany_filter, mix_controller
from lbt_synth.loop.disturbances import draw_phase
from lbt_synth.models import Accelerometer, Motion, SensorSuite, WavefrontSensor


@needs_specula
@pytest.mark.parametrize(("method", "delay"), [("integrator", 2.5), ("kalman", 2.0)])
def test_in_the_linear_range_it_is_the_modal_loop(calibration, method, delay):
    """A vibration of 60 nm and a bright star: residual and gain as the exact analysis says."""
    path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=delay)
    setup = replace(SETUP, hardware=path, vibrations=(SHAKE,), settle_frames=300)
    design = lbt.kalman(PLANT) if method == "kalman" else lbt.integrator(path, gain=0.3)
    run = run_end_to_end(setup, design, calibration=calibration)
    assert run.tip_tilt_gain == pytest.approx(1.0, abs=0.05)
    truth = lbt.Truth(turbulence=None, vibrations=(SHAKE,), sensor_gain=run.tip_tilt_gain)
    loop = lbt.close_loop(path, design.controller, sensor_gain=run.tip_tilt_gain)
    expected = lbt.residual_budget(loop, truth, frame_means=True).rms_nm
    found = np.hypot(*run.rms_nm[:2])
    # what the air and the photons add, in squares
    quiet = run_end_to_end(replace(setup, vibrations=()), design, calibration=calibration)
    still = np.hypot(*quiet.rms_nm[:2])
    assert np.sqrt(found**2 - still**2) == pytest.approx(expected, rel=0.04)
    assert still < expected


@needs_specula
def test_the_same_seed_is_the_same_run_and_the_same_air(calibration):
    setup = replace(SETUP, frames=20, settle_frames=200, vibrations=(SHAKE,))
    run = partial(run_end_to_end, calibration=calibration)
    first, second = run(setup, None), run(setup, None)
    assert np.array_equal(first.residual_nm, second.residual_nm)
    assert np.array_equal(first.psf, second.psf)
    other = run(replace(setup, seed=1), None)
    assert not np.allclose(first.residual_nm, other.residual_nm)
    # with both mirrors at rest, the phase is that of air and vibration alone
    still = replace(setup, gain=0.0)
    a = run(still, None)
    b = run(setup, lbt.integrator(PATH, gain=0.3))
    taps = PATH.mirror_taps
    corrected = taps[1] * b.commands[:-1] + taps[0] * b.commands[1:]
    assert np.allclose(b.residual_nm[1:] + corrected, a.residual_nm[1:], atol=0.02)


@needs_specula
@pytest.mark.parametrize(
    ("returned", "match"),
    [(np.zeros(3), r"must have shape \(2,\)"), (np.full(2, np.nan), "finite")],
)
def test_a_controller_that_returns_something_else(calibration, returned, match):
    odd = SimpleNamespace(step=lambda _: returned, reset=lambda: None)
    short = replace(SETUP, frames=2, settle_frames=200)
    with pytest.raises(ProblemError, match=match):
        run_end_to_end(short, odd, calibration=calibration)


def test_leaks_and_gains_of_the_mixed_controller(setup):
    control = mix_controller(setup, None)
    first = control.step(np.ones(672))
    assert set(first) == {setup.gain}
    second = control.step(np.zeros(672))
    assert second[49] == setup.gain
    assert second[50] == pytest.approx(setup.leak * setup.gain)


def test_the_optical_gain_is_found_within_its_error(setup):
    run = make_run(replace(setup, modes=60))
    gain, error, _ = run.optical_gain()
    apart = (gain - 0.5) / error
    assert 0.7 < np.std(apart) < 1.3
    found = run.summary()
    assert abs(run.tip_tilt_gain - 0.5) < 4 * found["tip_tilt_gain_error"]
    assert found["tip_tilt_noise_nm"] == pytest.approx(10, rel=0.05)
    assert run.rms_nm == pytest.approx(np.full(60, 50), rel=0.05)


def test_the_strehl_ratio_and_its_error(setup):
    run = make_run(replace(setup, modes=3), frames=8000)
    assert run.strehl == pytest.approx(0.8, abs=1e-3)
    assert run.strehl_error == pytest.approx(0.01 / np.sqrt(8000), rel=0.6)
    assert run.other_modes_strehl == pytest.approx(0.85)
    short = make_run(replace(setup, modes=3), frames=10)
    assert np.isnan(short.strehl_error)


LENGTH = {"frames": 1600, "settle_frames": 400, "seed": 2}
# faint enough that the noise of the pyramid decides, as it does of a dim star
DIM = replace(SETUP, photons=30.0, read_noise_electrons=4.0)
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
SHAKEN = lbt.Truth(turbulence=None, vibrations=SHAKES, motions=MOTIONS)
SETTINGS = replace(DIM, vibrations=SHAKES, motions=MOTIONS, leak_from_mode=2, leak=0.99, **LENGTH)


def dim_filter(*sensors, modes=2, noise_nm=15.0, **changes):
    """A Kalman filter of the small telescope's loop and of its accelerometer."""
    lines = [
        lbt.Vibration(
            frequency_hz=shake.frequency_hz,
            damping=0.005,
            rms_nm=shake.rms_nm,
            direction=shake.direction if modes == 2 else (1,),
        )
        for shake in SHAKES
    ]
    models = {"turbulence": PLANT.turbulence[0], "noise_nm": noise_nm, "vibrations": lines}
    own = lbt.tip_tilt_plant(frame_rate_hz=800, modes=modes, **models, **changes)
    suite = SensorSuite(sensors=sensors or (MIRROR,))
    motions = MOTIONS if suite.channels else ()
    return lbt.kalman(own.with_sensors(suite, motions))


@pytest.fixture(scope="module")
def shaking():
    return dim_filter()


def test_channels_follow_the_motions_that_shake_the_telescope():
    quiet = dim_filter(replace(MIRROR, noise_m_s2=1e-7))
    own = accompany_filter(quiet, SETTINGS)
    options = {"frames": 2000, "cases": 1, "zero_frame": 400, "frame_means": True}
    phase, _ = draw_phase(SHAKEN, PATH, rng=np.random.default_rng(2), **options)
    tilts, reading = phase[0], partial(sinusoid_reading, PATH, MIRROR)
    # the second line alone has a part along tilt
    second = tilts[:, 1] / 0.8
    moved = {0: tilts[:, 0] - 0.6 * second, 1: second}
    for column, channel in enumerate(("m1", "m2")):
        expected = sum(
            reading(MOTIONS[line][channel], SHAKES[line].frequency_hz, motion)
            for line, motion in moved.items()
            if channel in MOTIONS[line]
        )
        np.testing.assert_allclose(own.others[5:-1, column], expected[5:-1], atol=1e-6)


def test_a_further_wavefront_sensor_is_not_read(shaking):
    both = dim_filter(TRUTH_SENSOR, MIRROR)
    with_truth, without = (accompany_filter(design, SETTINGS) for design in (both, shaking))
    rows = both.problem.hardware.suite.rows(PATH)
    assert not with_truth.controller.B[:, :, rows["truth"]].any()
    y = np.random.default_rng(1).standard_normal((200, 2))
    # the readings have other noise: only the wavefront's part is compared
    still = [replace(each, others=0 * each.others) for each in (with_truth, without)]
    steps = [np.array([each.step(one) for one in y]) for each in still]
    np.testing.assert_allclose(steps[0], steps[1], rtol=1e-6, atol=1e-9)


def test_controllers_that_do_not_fit_are_refused(setup, shaking):
    """Another loop, mirror or motion of a channel, other modes, or no steps."""
    mirror = lbt.load_config("examples/lbt_slow_mirror.yaml")
    slow = lbt.lqg(mirror.plant)
    assert mix_controller(mirror.end_to_end, slow).n_modes == 672
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=1000), gain=0.5)
    late = dim_filter(replace(MIRROR, delay_frames=2), delay_frames=2.5)
    single, still = dim_filter(TRUTH_SENSOR, modes=1), replace(SETTINGS, motions=({}, {}))

    rows = [
        (partial(run_end_to_end, setup, object()), ProblemError, "step"),
        (partial(mix_controller, setup, other), ProblemError, r"1000 Hz and 2 frames"),
        (partial(mix_controller, setup, slow), ProblemError, "another mirror"),
        (
            partial(mix_controller, still, shaking),
            ProblemError,
            r"moves a channel of the design \(m1, m2\)",
        ),
        (
            partial(mix_controller, SETTINGS, single),
            DimensionError,
            "two measurements .* got 1 to 1",
        ),
        (partial(mix_controller, SETTINGS, late), ProblemError, "800 Hz and 2.5 frames"),
    ]
    require_refusals(rows)


@needs_specula
def test_with_accelerometers_a_dim_star_leaves_less_as_predicted(shaking, calibration):
    """All sensors against the wavefront only, each as the exact analysis says of the pyramid's noise."""
    found, expected = {}, {}
    alone = lbt.kalman(shaking.problem.own_sensor_alone())
    for name, design in {"all": shaking, "alone": alone}.items():
        run = run_end_to_end(SETTINGS, design, calibration=calibration)
        noise_nm = run.summary()["tip_tilt_noise_nm"]
        truth = replace(SHAKEN, noise_nm=noise_nm, sensor_gain=run.tip_tilt_gain)
        loop = design.close(PATH, sensor_gain=run.tip_tilt_gain)
        found[name] = np.hypot(*run.rms_nm[:2])
        expected[name] = lbt.residual_budget(loop, truth, frame_means=True).rms_nm
    for name, value in found.items():
        assert value == pytest.approx(expected[name], rel=0.1)
    assert found["all"] < 0.7 * found["alone"]
