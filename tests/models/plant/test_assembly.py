"""Plants of several sensors: what they hold, and where they are plants of one."""

import numpy as np
import pytest
from support.periodic_problems import relative_distance
from support.sensor_loops import AIR, FAST, LINES, MOTIONS, SLOW, example_plant, held_mean

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.models import Accelerometer, SensorSuite, WavefrontSensor, fused_plant
from lbt_synth.models.plant.readings import Exposure, memory, own_exposure, suite_exposures


@pytest.mark.parametrize(
    ("age", "period", "common"),
    [
        (1, 1, 1),
        (3, 1, 1),
        (2.3, 1, 1),
        (2, 2, 2),
        (2, 2, 4),
        (2.5, 2, 2),
        (7.6, 3, 6),
        (20, 20, 20),
        (39, 20, 20),
        (40, 20, 60),
        (59.5, 20, 20),
    ],
)
def test_a_reading_is_the_mean_of_its_exposure(age, period, common):
    signal = np.random.default_rng(0).standard_normal((200, 2))
    response = np.array([[1.0, 0.5], [0.0, 2.0], [1.0, -1.0]])
    exposure = Exposure(response=response, age_frames=float(age), period=period)
    held, compared = memory([exposure], 2, common, 1e-3), 0
    x = np.zeros(held.n_states)
    for k, s in enumerate(signal):
        t = k % common
        if k % period == 0 and k > age:
            expected = response @ held_mean(signal, k, age, period)
            np.testing.assert_allclose(held.C[t] @ x, expected, atol=1e-12)
            compared += 1
        x = held.A[t] @ x + held.B[t] @ s
    assert compared > 5
    assert held.n_states <= 2 * (2 + age // period)


def test_sensors_side_by_side():
    path = lbt.LoopHardware(frame_rate_hz=1000, delay_frames=2.5, modes=2)
    slow = WavefrontSensor(name="truth", rate_hz=250, delay_frames=2, noise_nm=4)
    exposures = [own_exposure(path), *suite_exposures(SensorSuite(sensors=(slow,)), path)]
    assert [(e.age_frames, e.period) for e in exposures] == [(1.0, 1), (6.5, 4)]
    both = memory(exposures, 2, 4, path.dt_s)
    alone = [memory([each], 2, 4, path.dt_s) for each in exposures]
    assert both.n_states == sum(each.n_states for each in alone)
    n = alone[0].n_states
    np.testing.assert_array_equal(both.A[:, n:, n:], alone[1].A)
    np.testing.assert_array_equal(both.C[:, 2:, n:], alone[1].C)
    assert not both.A[:, :n, n:].any()
    assert not both.C[:, :2, n:].any()


@pytest.mark.parametrize("delay", [1, 2, 2.4, 3])
def test_channels_that_see_nothing_leave_the_filter_of_the_wavefront(delay):
    fast = Accelerometer(
        name="mirror", rate_hz=500, delay_frames=2, channels=("m1",), noise_m_s2=1.0
    )
    plant = example_plant((fast,), motions=({}, {}), delay_frames=delay)
    alone, n = lbt.kalman(plant.own), plant.own.n_states
    solution = lbt.linear.periodic_kalman(plant)
    assert plant.period == 2
    for P, gains in zip(solution.P, solution.gains, strict=True):
        assert relative_distance(gains[:n, :2], alone.gain_predictor) < 1e-9
        assert not gains[:, 2:].any()
        power = np.trace(plant.L @ P @ plant.L.T)
        assert power == pytest.approx(alone.rms**2, rel=1e-9)
    # and so does its controller
    own, fused = alone.controller, plant.controller(solution.gains)
    y = np.random.default_rng(0).standard_normal((50, 3))
    states, commands = [np.zeros(own.n_states), np.zeros(fused.n_states)], np.zeros((2, 50, 2))
    for k in range(50):
        for i, (c, used) in enumerate(((own, y[k, :2]), (fused.phase(k), y[k]))):
            states[i] = c.A @ states[i] + c.B @ used
            commands[i, k] = c.C @ states[i] + c.D @ used
    np.testing.assert_allclose(commands[1], commands[0], atol=1e-9)


def test_what_a_plant_holds():
    plant = example_plant()
    assert plant.period == 4
    assert plant.n_measurements == 6
    assert plant.unit_rows(("m2", "wavefront")).tolist() == [1, 1, 0, 0, 0, 1]
    # of a line three states for two, and two ends of exposures: of the first line, which channels
    # see at two phases, position and velocity; a sum and two readings that wait, of two modes
    assert plant.n_states == plant.own.n_states + (1 + 4) + (1 + 2) + 3 * 2
    assert plant.n_known == 2 + 3 * 2
    assert "4 sensors, period 4" in plant._brief()


def test_lines_that_no_channel_sees_stay_in_place():
    plant = example_plant((FAST,), motions=({}, MOTIONS[1]))
    own = plant.own
    kept = [0, 2, *range(4, own.n_states)]  # without the samples of the second line
    np.testing.assert_array_equal(plant.A[0][: len(kept), : len(kept)], own.A[np.ix_(kept, kept)])
    # its mean position has its place in the total phase, and no channel sees the first line
    position = plant.A[0][len(kept) - 2 : len(kept), len(kept)]
    np.testing.assert_allclose(position, LINES[1].direction, rtol=1e-12)
    assert not plant.C[0][2:, : len(kept)].any()


def test_noise_of_a_reading_is_that_of_nothing_else():
    plant = example_plant()
    assert not (plant.B @ plant.D.transpose(0, 2, 1)).any()


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: fused_plant(1, SensorSuite(sensors=(SLOW,))), ProblemError, "own must be a"),
        (lambda: fused_plant(example_plant().own, (SLOW,)), ProblemError, "suite must be a"),
        (
            lambda: fused_plant(example_plant().own, SensorSuite(sensors=(FAST,)), ({},)),
            DimensionError,
            "one mapping per vibration",
        ),
        (lambda: example_plant().controller(np.zeros((1, 2, 3))), DimensionError, "gains must be"),
        (lambda: example_plant().unit_rows(("m9",)), ProblemError, "called 'm9'"),
        (
            lambda: example_plant(delay_frames=4, sensors=(FAST,)),
            ProblemError,
            "sensor mirror must be at least 3 of its frames",
        ),
    ],
)
def test_refusals(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_a_plant_of_turbulence_alone():
    plant = example_plant((SLOW,), lines=(), motions=())
    assert plant.own.turbulence == (AIR, AIR)
    assert plant.n_measurements == 4
