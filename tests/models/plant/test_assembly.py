"""Plants of several sensors: what they hold, and where they are plants of one."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.periodic_problems import relative_distance
from support.refusals import require_refusals
from support.sensor_loops import AIR, FAST, MOTIONS, SLOW, example_plant, held_mean

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.models import Accelerometer, Motion, SensorSuite, WavefrontSensor
from lbt_synth.models.plant.assembly import sensor_memory
from lbt_synth.models.plant.tip_tilt import retuned_plant

SEEING = Accelerometer(
    name="mirror", rate_hz=1000, delay_frames=1, channels=("m1",), noise_m_s2=2e-4
)


@pytest.mark.parametrize(
    ("age", "period", "common"),
    [(1, 1, 1), (2.3, 1, 1), (2, 2, 4), (2.5, 2, 2), (7.6, 3, 6), (20, 20, 20), (59.5, 20, 20)],
)
def test_a_reading_is_the_mean_of_its_exposure(age, period, common):
    signal = np.random.default_rng(0).standard_normal((200, 2))
    response = np.array([[1.0, 0.5], [0.0, 2.0], [1.0, -1.0]])
    sensor = WavefrontSensor(
        name="other",
        rate_hz=800 / period,
        delay_frames=(age + 1) / period,
        noise_nm=1.0,
        sensor_matrix=response,
    )
    rare = replace(SEEING, rate_hz=800 / common, delay_frames=2)
    path = lbt.LoopHardware(frame_rate_hz=800, suite=SensorSuite(sensors=(sensor, rare)))
    (A, B, C), compared = sensor_memory(path), 0
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
    fast = Accelerometer(
        name="mirror", rate_hz=500, delay_frames=2, channels=("m1",), noise_m_s2=1.0
    )
    plant = example_plant((fast,), motions=({}, {}), delay_frames=delay)
    own = plant.own_sensor_alone()
    alone, n = lbt.kalman(own), own.n_states
    solution = kalman_riccati(plant)
    assert plant.period == 2
    for P, gains in zip(solution.P, solution.gain_predictor, strict=True):
        assert relative_distance(gains[:n, :2], alone.gain_predictor) < 1e-9
        assert not gains[:, 2:].any()
        power = np.trace(plant.L @ P @ plant.L.T)
        assert power == pytest.approx(alone.rms**2, rel=1e-9)
    # and so does its controller
    both = plant.controller(solution.gain_predictor)
    y = np.random.default_rng(0).standard_normal((50, 3))
    running, alike = both.start(), alone.controller.start()
    commands = np.array([(running.step(each), alike.step(each[:2])) for each in y])
    np.testing.assert_allclose(commands[:, 0], commands[:, 1], atol=1e-9)


def test_what_a_plant_holds():
    plant = example_plant()
    own = plant.own_sensor_alone()
    assert (plant.period, own.period, plant.n_measurements) == (4, 1, 6)
    assert plant.hardware.suite.marked(("m2", "wavefront"), plant.hardware).tolist() == [
        *(1, 1, 0, 0, 0, 1)
    ]
    # of a line three states for two, and two ends of exposures: of the first line, which channels
    # see at two phases, position and velocity; a sum and two readings that wait, of two modes
    assert plant.n_states == own.n_states + (1 + 4) + (1 + 2) + 3 * 2
    assert plant.full().n_states == plant.n_states + 2 + 3 * 2
    assert "4 sensors" in plant._brief()
    assert plant.turbulence == own.turbulence == (AIR, AIR)
    np.testing.assert_allclose(plant.own_noise_factor, 75 * np.eye(2))
    again = own.with_sensors(plant.hardware.suite, plant.motions)
    np.testing.assert_array_equal(again.A, plant.A)
    assert own.own_sensor_alone() is own


def test_lines_that_move_keep_their_channels():
    plant = example_plant()
    shifted = retuned_plant(plant, [5.0, -5.0])
    assert shifted.motions == plant.motions
    spread = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=3)
    assert spread.motions == (plant.motions[0],) * 3 + (plant.motions[1],) * 3
    one = lbt.models.spread_plant(plant, half_width_hz=1.0, lines=1)
    np.testing.assert_allclose(one.C, plant.C, rtol=1e-12)


@pytest.mark.parametrize("sections", [2, 4])
def test_a_bump_is_a_chain_of_resonances(sections):
    """The filter leaves what the same bump as one process of order 2 a section leaves."""
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=2, frame_rate_hz=1000)
    bump = lbt.Vibration(frequency_hz=40, damping=0.2, rms_nm=100, sections=sections)
    line = lbt.Vibration(frequency_hz=90, damping=0.01, rms_nm=20)
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=1000, turbulence=slow, vibrations=[bump, line], noise_nm=5
    )
    assert plant.n_states == 2 * sections + 2 + 4
    design = lbt.kalman(plant)
    assert design.certificate.passed
    loop = lbt.close_loop(plant.hardware, design.controller)
    left = lbt.residual_budget(loop, plant, frame_means=True)
    assert left.rms_nm == pytest.approx(design.rms, rel=1e-6)
    moved = tuple({} for _ in plant.vibrations)
    assert plant.with_sensors(SensorSuite(sensors=(SEEING,)), moved).n_states == plant.n_states
    with pytest.raises(ProblemError, match="moves no channel of an accelerometer"):
        plant.with_sensors(SensorSuite(sensors=(SEEING,)), ({"m1": Motion(size=1)}, {}))


@pytest.mark.parametrize("steps", [0, 3])
def test_a_prediction_further_ahead_has_the_same_readings(steps):
    plant = example_plant((FAST,))
    parts = {name: getattr(plant, name) for name in "ABCDL"}
    bare = lbt.EstimationProblem(**parts)  # which predicts without knowing of sensors
    expected = lbt.kalman(bare.ahead(steps)).rms
    assert lbt.kalman(plant.ahead(steps)).rms == pytest.approx(expected, rel=1e-9)
    several = example_plant()
    near, far = several.hardware, several.ahead(steps).hardware
    for one, other in zip(near.suite.sensors, far.suite.sensors, strict=True):
        assert other.age_frames(far) == pytest.approx(one.age_frames(near))


def test_refusals():
    plant, suite = example_plant(), SensorSuite(sensors=(FAST,))
    motions = {"motions": MOTIONS[:1]}
    rows = [
        (partial(plant.with_sensors, (SLOW,)), ProblemError, "suite must be a"),
        (partial(plant.with_sensors, suite, MOTIONS[:1]), DimensionError, "mapping per vibration"),
        (partial(replace, plant.parts(), **motions), DimensionError, "one mapping"),
        (
            partial(plant.controller, np.zeros((1, 2, 3))),
            DimensionError,
            "gain_predictor must have",
        ),
        (partial(example_plant, (FAST,), delay_frames=4), ProblemError, "at least 3 of its frames"),
        (partial(plant.require_own_sensor, "this"), ProblemError, "truth, m1, m2 see, too"),
    ]
    require_refusals(rows)
