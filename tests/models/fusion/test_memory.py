"""What sensors remember, against means over the frames of an exposure."""

import numpy as np
import pytest
from support.fused_loops import held_mean

import lbt_synth as lbt
from lbt_synth.models import SensorSuite, WavefrontSensor
from lbt_synth.models.fusion.memory import Exposure, memory, own_exposure, suite_exposures


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
