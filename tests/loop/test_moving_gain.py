"""A sensor gain that moves: what is proved lies inside what a sequence breaks."""

from __future__ import annotations

import numpy as np
import pytest
from support.plants import lbt_axis_plant

import lbt_synth as lbt


@pytest.mark.parametrize("modes", [1, 2])
@pytest.mark.parametrize("design", [lbt.kalman, lambda p: lbt.hinf(p, gamma_ratio=1.2)])
def test_intervals_lie_in_each_other(design, modes):
    plant = lbt_axis_plant(modes=modes)
    moving = lbt.loop.moving_gain(lbt.close_loop(plant.hardware, design(plant)))
    lows = moving.constant_low, moving.broken_low, moving.fast_low, 1.0
    highs = moving.constant_high, moving.broken_high, moving.fast_high, 1.0
    assert lows == tuple(sorted(lows))
    assert highs == tuple(sorted(highs, reverse=True))
    # what is not known is less than a fifth of the proved interval
    assert moving.broken_high / moving.broken_low < 1.2 * moving.fast_high / moving.fast_low
    widths = (moving.constant_high - moving.constant_low, moving.slow_high - moving.slow_low)
    assert widths[1] == pytest.approx(widths[0], rel=0.1)


def test_the_faster_the_gain_the_narrower_and_never_below_any_speed():
    plant = lbt_axis_plant()
    loop = lbt.close_loop(plant.hardware, lbt.kalman(plant))
    found = [lbt.loop.moving_gain(loop, rate_per_s=rate) for rate in (0.1, 1.0, 10.0, 1e4)]
    ratios = [each.slow_high / each.slow_low for each in found]
    assert ratios == sorted(ratios, reverse=True)
    assert (found[3].slow_low, found[3].slow_high) == (found[3].fast_low, found[3].fast_high)
    assert len({each.fast_low for each in found}) == 1


def test_intervals_are_of_the_sensor_gain_whatever_the_loop_has():
    plant = lbt_axis_plant()
    controller = lbt.kalman(plant).controller
    loop = lbt.close_loop(plant.hardware, controller, sensor_gain=0.5)
    moving = lbt.loop.moving_gain(loop)
    assert moving.fast_low < 0.5 < moving.fast_high < moving.constant_high
    expected = lbt.loop.stable_sensor_gains(plant.hardware, controller)
    assert (moving.constant_low, moving.constant_high) == pytest.approx(expected)


def test_an_unstable_loop_and_a_wrong_rate_are_refused():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    wild = lbt.Controller(A=1.0, B=1.5, C=1.0, D=0.0, dt_s=1 / 800)
    with pytest.raises(lbt.errors.UnstableLoopError):
        lbt.loop.moving_gain(lbt.close_loop(path, wild))
    tame = lbt.Controller(A=1.0, B=0.5, C=1.0, D=0.0, dt_s=1 / 800)
    with pytest.raises(lbt.errors.ProblemError, match="rate_per_s"):
        lbt.loop.moving_gain(lbt.close_loop(path, tame), rate_per_s=0)


def test_a_loop_that_the_gain_does_not_touch_is_proved_for_all_gains():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    idle = lbt.Controller(A=0.5, B=0.0, C=1.0, D=0.0, dt_s=1 / 800)
    moving = lbt.loop.moving_gain(lbt.close_loop(path, idle))
    assert (moving.fast_low, moving.fast_high) == (0.01, 100.0)
    assert moving.broken_low is None
    assert np.isinf(moving.constant_high)
