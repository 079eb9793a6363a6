"""Step responses against the recursion of the loop, frame by frame."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt

PATH = lbt.LoopHardware(frame_rate_hz=500, modes=1)


def step(gain, path=PATH, **more):
    loop = lbt.close_loop(path, lbt.integrator(path, gain=gain).controller)
    return lbt.loop.step_response(loop, **more)


def test_a_step_is_answered_frame_by_frame():
    found = step(0.5)
    assert found.time_s[:2] == pytest.approx([0, 0.002])
    # two frames pass before anything moves: y(1) sees the step, u(1) acts in frame 2
    expected, u = [1.0], [0.0]
    for k in range(1, 20):
        u.append(u[-1] + 0.5 * expected[k - 1])
        expected.append(1.0 - u[k - 1])
    assert found.residual[:20] == pytest.approx(expected)
    assert found.command[:20] == pytest.approx(u)
    assert found.overshoot_percent == pytest.approx(-100 * min(expected))


def test_settling_is_the_last_time_outside_five_percent():
    found = step(0.1)
    after = round(found.settling_s * 500)
    assert abs(found.residual[after - 1]) > 0.05
    assert np.all(np.abs(found.residual[after:]) <= 0.05)
    assert np.isnan(step(0.1, frames=5).settling_s)


def test_the_step_is_on_the_axis_that_is_named():
    path = lbt.LoopHardware(frame_rate_hz=500, modes=2)
    assert step(0.3, path, axis=1).residual == pytest.approx(step(0.3).residual)
    with pytest.raises(lbt.errors.ProblemError, match="axis must be below 2"):
        step(0.3, path, axis=2)
