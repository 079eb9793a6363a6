"""Sensors beside the loop's own: ages, schedules, accelerations, refusals."""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import block_diag
from support.refusals import require_refusals
from support.sensor_loops import FAST, SLOW

from lbt_synth.errors import ProblemError
from lbt_synth.models import Accelerometer, LoopHardware, Motion, SensorSuite, WavefrontSensor
from lbt_synth.models.sensor_suite import checked_motions, period_frames

PATH = LoopHardware(frame_rate_hz=1000, delay_frames=2, modes=2)
wavefront = partial(WavefrontSensor, name="truth", rate_hz=250, delay_frames=3, noise_nm=4.0)
readings = {"rate_hz": 1000, "delay_frames": 2, "noise_m_s2": 2e-4}
accelerometer = partial(Accelerometer, name="mirror", channels=("m1", "m2"), **readings)


def suite(*sensors):
    return SensorSuite(sensors=sensors)


@pytest.mark.parametrize(
    ("delay", "sensor", "age"),
    [
        (2, wavefront(), 11),
        (2.5, wavefront(delay_frames=1.5), 4.5),
        (1, wavefront(rate_hz=1000, delay_frames=1), 1),
        (2, accelerometer(), 1),
        (2, accelerometer(delay_frames=1), 0),
        (3, accelerometer(rate_hz=500, delay_frames=1.75), 1.5),
        (3, accelerometer(rate_hz=500, delay_frames=1.5), 1),
        (1.5, accelerometer(delay_frames=1), 0.5),
    ],
)
def test_ages(delay, sensor, age):
    path = LoopHardware(frame_rate_hz=1000, delay_frames=delay, modes=2)
    assert sensor.age_frames(path) == pytest.approx(age)


def test_the_schedule_of_rates_that_do_not_divide_each_other():
    other = wavefront(name="other", rate_hz=100, sensor_matrix=[[1.0, 1.0]])
    sensors = suite(accelerometer(rate_hz=1000 / 3), wavefront(rate_hz=50), other)
    assert sensors.period(PATH) == 60
    names, ends = ("wavefront", "truth", "other", "m1", "m2"), (0, 2, 4, 5, 6, 7)
    assert sensors.units == tuple(sensors.rows(PATH)) == names
    assert [(row.start, row.stop) for row in sensors.rows(PATH).values()] == [*pairwise(ends)]
    read = sensors.read(PATH)
    assert read.shape == (60, 7)
    for column, period in ((0, 1), (2, 20), (5, 3)):
        assert np.flatnonzero(read[:, column]).tolist() == [*range(0, 60, period)]
    assert sensors.marked(("m2", "truth"), PATH).tolist() == [0, 0, 1, 1, 0, 0, 1]


def test_the_noise_of_all_sensors():
    factor = suite(FAST, SLOW).noise_factor(np.diag([15.0, 15.0]), 2)
    expected = block_diag(225 * np.eye(2), SLOW.noise_nm, FAST.noise_m_s2)
    np.testing.assert_allclose(factor @ factor.T, expected)


def test_refusals():
    late, moved = accelerometer(rate_hz=500, delay_frames=1.25), ({"m1": Motion(size=1)},)
    odd = (wavefront(rate_hz=1000 / 7), accelerometer(rate_hz=1000 / 211))
    strange = ({"m9": Motion(size=1)},)
    rows = [
        (lambda: wavefront(delay_frames=0.5), "delay_frames.* at least 1"),
        (lambda: wavefront(noise_nm=0.0).noise_factor(2), "noise_nm.* positive|above 0"),
        (lambda: accelerometer(channels=()), r"channels of mirror .* at least one; got \(\)"),
        (lambda: accelerometer(channels=("m1", "m1")), "channels of mirror must be different"),
        (lambda: wavefront(sensor_matrix=np.eye(3)).response(2), "must have 2 columns"),
        (lambda: wavefront(delay_frames=1).age_frames(PATH), "at least 1.25 of its frames.*got 1"),
        (lambda: late.age_frames(replace(PATH, delay_frames=3)), "1.5 of its frames.*got 1.25"),
        (lambda: period_frames(wavefront(rate_hz=300), PATH), "whole multiple .*got 300 Hz"),
        (lambda: period_frames(wavefront(rate_hz=0.5), PATH), "up to 1000"),
        (lambda: suite(wavefront(name="wavefront")), "none of them 'wavefront'"),
        (lambda: suite(accelerometer(), wavefront(name="m1")), "different names"),
        (lambda: suite(*odd).period(PATH), "at most 1000 frames; got 1477"),
        (lambda: suite(wavefront()).marked(("m9",), PATH), "'m9'; there are wavefront, truth"),
        (lambda: checked_motions(strange, suite(FAST), 1), "'m9'; the channels are m1, m2"),
        (lambda: checked_motions(moved, suite(SLOW), 1), "the channels are none"),
        (lambda: checked_motions(({},), suite(FAST), 2), r"one mapping per vibration \(2\); got 1"),
    ]
    require_refusals((make, ProblemError, words) for make, words in rows)
