"""Plants: the paper's state, entry by entry, its two forms, and what several sensors add."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.periodic_problems import relative_distance
from support.plants import lbt_axis_plant
from support.refusals import require_refusals
from support.sensor_loops import AIR, FAST, MOTIONS, SLOW, example_plant, held_mean

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.models import Accelerometer, ARModel, Motion, SensorSuite, WavefrontSensor
from lbt_synth.models.plant.assembly import sensor_memory
from lbt_synth.models.plant.tip_tilt import retuned_plant

RATE = 800
AR1 = ARModel(coefficients=[0.98], driving_rms_nm=50.0, frame_rate_hz=RATE)
CHANNEL = Accelerometer(name="mirror", rate_hz=500, delay_frames=2, channels=("m1",), noise_m_s2=1)
small_plant = partial(lbt.tip_tilt_plant, frame_rate_hz=RATE, turbulence=AR1, noise_nm=2.0)


@pytest.fixture(scope="module")
def plant():
    return lbt_axis_plant()


@pytest.mark.parametrize(
    ("delay", "coefficients", "commands", "sections"),
    [(1, [0.99], 2, 2), (2, [1.95, -0.955], 5, 4), (4, [0.99], 2, 1)],
)
def test_predicted_error_is_the_closed_loops_residual(delay, coefficients, commands, sections):
    """Where truth is the model, the filter's rms is the residual of the loop, exactly."""
    air = ARModel(coefficients=coefficients, driving_rms_nm=20, frame_rate_hz=RATE)
    lines = (
        lbt.Vibration(frequency_hz=23, damping=0.02, rms_nm=120, direction=(0.6, 0.8)),
        lbt.Vibration(frequency_hz=40, damping=0.2, rms_nm=100, sections=sections),
    )
    truth, rng = {"turbulence": air, "vibrations": lines, "noise_nm": 9.0}, np.random.default_rng(3)
    plant = small_plant(
        **truth,
        delay_frames=delay,
        sensor_matrix=rng.standard_normal((3, 2)),
        influence_matrix=rng.standard_normal((2, commands)),
    )
    assert plant.n_states == 2 * (sections + 1 + len(coefficients) + max(delay - 1, 1))
    design = lbt.kalman(plant)
    assert len(design.controller.C) == commands
    loop = lbt.close_loop(plant.hardware, design.controller)
    budget = lbt.residual_budget(loop, lbt.Truth(**truth), frame_means=True)
    assert budget.rms_nm == pytest.approx(design.rms, rel=1e-9)


def test_sensor_gain_of_the_design_is_undone():
    """A loop that is designed for sensor gain 0.5 behaves like the unit one at half the noise."""
    halved, unit = lbt.kalman(small_plant(sensor_gain=0.5)), lbt.kalman(small_plant(noise_nm=4.0))
    assert halved.rms == pytest.approx(unit.rms, rel=1e-12)
    assert np.allclose(0.5 * halved.gain_predictor, unit.gain_predictor, rtol=1e-10)
    covariance = np.array([[9.0, 2.0], [2.0, 4.0]])
    assert np.allclose(small_plant(noise_nm=covariance).R, covariance)


def test_retuning_moves_only_the_vibration(plant):
    moved = retuned_plant(plant, 1.5, hold="rms")
    assert moved.vibrations[0].frequency_hz == 21.5
    back, one = retuned_plant(moved, -1.5), lbt.models.spread_plant(plant, half_width_hz=1, lines=1)
    for same in (back, one):
        for name in "ABCDL":
            assert np.allclose(getattr(same, name), getattr(plant, name), rtol=1e-12)


def test_full_form_is_the_papers():
    """Two modes, one vibration on each: 2p + 2n + m = 10, equations 5 to 7."""
    lines = [
        lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=500, direction=(1, 0)),
        lbt.Vibration(frequency_hz=27, damping=0.02, rms_nm=300, direction=(0, 1)),
    ]
    rng = np.random.default_rng(1)
    sensor, influence = rng.standard_normal((3, 2)), rng.standard_normal((2, 2))
    matrices = {"sensor_matrix": sensor, "influence_matrix": influence}
    full = small_plant(vibrations=lines, **matrices).full()
    a = np.array([line.ar_model(RATE).coefficients for line in lines])
    A1, minus_A2 = np.diag(a[:, 0]), np.diag(a[:, 1])
    I, Z = np.eye(2), np.zeros((2, 2))
    shaken, air, seen = [A1, minus_A2, Z, Z, Z], [Z, Z, 0.98 * I, Z, Z], [I, Z, I, Z, Z]
    assert np.array_equal(full.A, np.block([shaken, [I, Z, Z, Z, Z], air, seen, [Z] * 5]))
    assert np.all(np.linalg.eigvals(minus_A2) < 0)
    assert np.array_equal(full.B_known, np.vstack([Z, Z, Z, Z, I]))
    assert np.array_equal(full.L, np.hstack([I, Z, I, Z, Z]))
    C = np.hstack([sensor @ m for m in (Z, Z, Z, I, -influence)])
    assert np.allclose(full.C, C, rtol=1e-15)
    assert not np.any(full.D_known)


@pytest.mark.parametrize(
    ("design", "delay"),
    [(lbt.kalman, 1), (lbt.kalman, 2.5), (partial(lbt.hinf, gamma_ratio=1.2), 3)],
)
def test_full_and_reduced_form_give_the_same_controller(design, delay):
    plant = lbt_axis_plant(delay_frames=delay)
    form, n = plant.full(), plant.n_states
    matrices = {name: getattr(form, name) for name in "ABCDL"}
    reduced, full = design(plant), design(lbt.EstimationProblem(**matrices, dt_s=plant.dt_s))
    scale = np.abs(reduced.gain_predictor).max()
    expected = np.vstack([reduced.gain_predictor, np.zeros((form.n_states - n, 1))])
    assert np.allclose(full.gain_predictor, expected, atol=1e-7 * scale)
    of_all = form.controller(full.gain_predictor, plant.hardware.projector @ form.L)
    f = np.geomspace(0.1, 400, 50)
    one, other = (c.to_statespace().frequency_response(f) for c in (reduced.controller, of_all))
    assert np.allclose(one, other, rtol=1e-6)


def test_the_spectrum_is_the_mean_of_the_moved_ones(plant):
    spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=4)
    line = plant.vibrations[0]
    f = np.concatenate([np.linspace(0, 400, 300), np.linspace(18, 22, 300)])
    moved = [line.at_frequency(g).ar_model(RATE).psd(f) for g in (19.25, 19.75, 20.25, 20.75)]
    total = sum(component.ar_model(RATE).psd(f) for component in spread.vibrations)
    np.testing.assert_allclose(total, np.mean(moved, axis=0), rtol=1e-11)
    assert np.hypot.reduce([v.rms_nm for v in spread.vibrations]) == pytest.approx(line.rms_nm)
    for component in spread.vibrations:
        assert component.damping * component.frequency_hz == pytest.approx(0.2)
        assert component.direction == line.direction
    assert lbt.kalman(spread).certificate.passed


@pytest.mark.parametrize(
    ("age", "period", "common"),
    [(1, 1, 1), (2.3, 1, 1), (2, 2, 4), (2.5, 2, 2), (7.6, 3, 6), (20, 20, 20), (59.5, 20, 20)],
)
def test_a_reading_is_the_mean_of_its_exposure(age, period, common):
    signal = np.random.default_rng(0).standard_normal((200, 2))
    response = np.array([[1.0, 0.5], [0.0, 2.0], [1.0, -1.0]])
    facts = {"rate_hz": RATE / period, "delay_frames": (age + 1) / period, "noise_nm": 1.0}
    sensor = WavefrontSensor(name="other", sensor_matrix=response, **facts)
    suite = SensorSuite(sensors=(sensor, replace(CHANNEL, rate_hz=RATE / common)))
    (A, B, C), compared = sensor_memory(lbt.LoopHardware(frame_rate_hz=RATE, suite=suite)), 0
    x = np.zeros(A.shape[1])
    for k, s in enumerate(signal):
        t = k % common
        if k % period == 0 and k > age:
            expected = response @ held_mean(signal, k, age, period)
            np.testing.assert_allclose(C[t] @ x, expected, atol=1e-12)
            compared += 1
        x = A[t] @ x + B[t] @ s
    assert compared > 5
    assert len(x) <= 2 * (2 + age // period)


@pytest.mark.parametrize("delay", [1, 2.4])
def test_channels_that_see_nothing_leave_the_filter_of_the_wavefront(delay):
    plant = example_plant((CHANNEL,), motions=({}, {}), delay_frames=delay)
    bare = plant.own_sensor_alone()
    alone, solution = lbt.kalman(bare), kalman_riccati(plant)
    assert (plant.period, plant.n_states) == (2, bare.n_states)
    for P, gains in zip(solution.P, solution.gain_predictor, strict=True):
        assert relative_distance(gains[:, :2], alone.gain_predictor) < 1e-9
        assert not gains[:, 2:].any()
        assert np.trace(plant.L @ P @ plant.L.T) == pytest.approx(alone.rms**2, rel=1e-9)
    # and so does its controller
    running, alike = plant.controller(solution.gain_predictor).start(), alone.controller.start()
    for y in np.random.default_rng(0).standard_normal((50, 3)):
        np.testing.assert_allclose(running.step(y), alike.step(y[:2]), atol=1e-9)


def test_what_a_plant_of_several_sensors_holds():
    plant = example_plant()
    bare, suite = plant.own_sensor_alone(), plant.hardware.suite
    assert (plant.period, bare.period, plant.n_measurements) == (4, 1, 6)
    marked = suite.marked(("m2", "wavefront"), plant.hardware)
    assert marked.tolist() == [1, 1, 0, 0, 0, 1]
    # of a line three states for two, and two ends of exposures: of the first line, which channels
    # see at two phases, position and velocity; a sum and two readings that wait, of two modes
    assert plant.n_states == bare.n_states + (1 + 4) + (1 + 2) + 3 * 2
    assert plant.full().n_states == plant.n_states + 2 + 3 * 2
    assert "4 sensors" in plant._brief()
    assert plant.turbulence == bare.turbulence == (AIR, AIR)
    np.testing.assert_allclose(plant.own_noise_factor, 75 * np.eye(2))
    np.testing.assert_array_equal(bare.with_sensors(suite, plant.motions).A, plant.A)
    assert bare.own_sensor_alone() is bare
    # lines that move keep their channels
    assert retuned_plant(plant, [5.0, -5.0]).motions == plant.motions
    spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=3)
    assert spread.motions == (plant.motions[0],) * 3 + (plant.motions[1],) * 3
    one = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=1)
    np.testing.assert_allclose(one.C, plant.C, rtol=1e-12)


@pytest.mark.parametrize("steps", [0, 3])
def test_a_prediction_further_ahead_has_the_same_readings(steps):
    plant, several = example_plant((FAST,)), example_plant()
    matrices = {name: getattr(plant, name) for name in "ABCDL"}
    bare = lbt.EstimationProblem(**matrices)  # which predicts without knowing of sensors
    expected = lbt.kalman(bare.ahead(steps)).rms
    assert lbt.kalman(plant.ahead(steps)).rms == pytest.approx(expected, rel=1e-9)
    ages = [
        [sensor.age_frames(hardware) for sensor in hardware.suite.sensors]
        for hardware in (several.hardware, several.ahead(steps).hardware)
    ]
    assert ages[1] == pytest.approx(ages[0])


def test_wrong_parts_are_refused(plant):
    line = lbt.Vibration(frequency_hz=9, damping=0.1, rms_nm=1)
    unequal = {"sensor_matrix": np.eye(3), "influence_matrix": np.eye(2)}
    blind = {"sensor_matrix": [[1 / 3, 0.1]], "influence_matrix": [[0.3], [-1.0]]}
    rows = [
        ({"noise_nm": 0.0}, "noise_nm must be above 0"),
        ({"noise_nm": [[1.0, 2.0], [0.0, 1.0]]}, "noise_nm must be symmetric"),
        ({"noise_nm": [[1.0, 2.0], [2.0, 1.0]]}, "noise_nm must be positive definite"),
        ({"noise_nm": np.eye(3)}, "to match the measurements"),
        ({"delay_frames": 20.5}, "delay_frames must be at most 20; got 20.5"),
        ({"sensor_gain": 0}, "sensor_gain must be above 0"),
        (unequal, "to match sensor_matrix"),
        (blind, "must see something that influence_matrix moves"),
        ({"sensor_matrix": [[np.nan, 0], [0, 1]]}, "sensor_matrix must be finite"),
        ({"turbulence": [AR1] * 3}, r"one per mode \(2\); got 3"),
        ({"turbulence": replace(AR1, frame_rate_hz=500)}, "must be sampled at the loop's 800 Hz"),
        ({"vibrations": [replace(line, direction=(1,))]}, "must have 2 components"),
        ({"vibrations": [replace(line, frequency_hz=450)]}, "below the Nyquist"),
        ({"vibrations": line}, "vibrations must be a list; got Vibration"),
        ({"vibrations": [1]}, "each vibration must be a Vibration; got int"),
        ({"turbulence": None}, "turbulence must be an ARModel; got NoneType"),
        ({"noise_nm": 1e-200}, "is singular. Every measurement needs noise"),
    ]
    require_refusals((partial(small_plant, **c), ProblemError, words) for c, words in rows)
    suite = SensorSuite(sensors=(replace(CHANNEL, rate_hz=RATE),))
    bumpy, motion = small_plant(vibrations=[replace(line, sections=2)]), ({"m1": Motion(size=1)},)
    spread, fast = lbt.models.spread_plant, retuned_plant(plant, 379.0)
    seen, gain = example_plant(), np.zeros((1, 2, 3))
    rows = [
        (lambda: spread(small_plant(), half_width_hz=1), ProblemError, "needs a plant with a vibr"),
        (lambda: spread(plant, half_width_hz=20), ProblemError, "must be below 20; got 20. All"),
        (lambda: spread(plant, half_width_hz=1, lines=65), ProblemError, "must be at most 64"),
        (lambda: spread(fast, half_width_hz=9), ProblemError, "below the Nyquist frequency"),
        (lambda: bumpy.with_sensors(suite, motion), ProblemError, "moves no channel of an accel"),
        (lambda: seen.with_sensors((SLOW,)), ProblemError, "suite must be a"),
        (lambda: seen.with_sensors(suite, motion), DimensionError, "mapping per vibration"),
        (lambda: replace(seen.parts(), motions=MOTIONS[:1]), DimensionError, "one mapping"),
        (lambda: seen.controller(gain), DimensionError, "gain_predictor must have"),
        (lambda: example_plant((FAST,), delay_frames=4), ProblemError, "at least 3 of its frames"),
        (lambda: seen.require_own_sensor("this"), ProblemError, "truth, m1, m2 see, too"),
    ]
    require_refusals(rows)
