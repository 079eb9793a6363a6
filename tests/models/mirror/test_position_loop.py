"""The local position loop of the mirror, against python-control and closed forms."""

from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq
from support.refusals import require_refusals

import lbt_synth as lbt

SLOW = {"natural_frequency_hz": 20, "damping": 0.5, "bandwidth_hz": 70, "delay_samples": 2}
shell = partial(
    lbt.models.PositionLoop.from_bandwidth, natural_frequency_hz=50, damping=0.5, bandwidth_hz=500
)


def test_the_step_is_that_of_a_second_order_system_when_sampled_fast():
    w, z = 2 * np.pi * 500, 0.6
    mirror = shell(bandwidth_damping=z, sampling_hz=2e6, delay_samples=0)
    step = mirror.step_response()
    t, wd = step.time_s, w * np.sqrt(1 - z**2)
    exact = 1 - np.exp(-z * w * t) * (np.cos(wd * t) + z / np.sqrt(1 - z**2) * np.sin(wd * t))
    np.testing.assert_allclose(step.position, exact, atol=2e-3)
    assert step.overshoot == pytest.approx(np.exp(-np.pi * z / np.sqrt(1 - z**2)), rel=2e-2)
    enters = brentq(lambda s: np.interp(s, t, exact) - 0.9, 0, np.pi / wd)
    assert step.settling_s == pytest.approx(enters, rel=2e-3)


@pytest.mark.parametrize("changes", [{}, {"ramp_samples": 37, "delay_samples": 0}, SLOW])
def test_a_step_response_in_blocks_is_that_sample_by_sample(changes):
    mirror = shell(**changes)
    loop, step = mirror.closed_loop(), mirror.step_response()
    state = np.zeros(loop.n_states)
    for i in range(300):
        assert step.position[8 * i] == pytest.approx(state[0], abs=1e-12)
        r = min(1.0, (i + 1) / mirror.ramp_samples)
        state = loop.A @ state + loop.B[:, 0] * r


def test_impossible_local_loops_are_refused():
    none = dict.fromkeys(("proportional_per_s2", "derivative_per_s", "feed_forward"), 0)
    forceless = {"natural_frequency_hz": 10, "damping": 1, **none}
    rows = [
        (partial(shell, bandwidth_hz=30), "bandwidth_hz must be at least 50"),
        (partial(shell, natural_frequency_hz=0), "natural_frequency_hz must be above 0"),
        (partial(shell, bandwidth_hz=5000, delay_samples=6), "local loop of the mirror must be st"),
        (partial(shell, delay_samples=1000), "delay_samples must be at most 64"),
        (partial(shell, sampling_hz=80.0), "natural_frequency_hz must lie below half"),
        (partial(shell, feed_forward=11), "feed_forward must be at most 10"),
        (partial(shell, damping=20.0), "bandwidth_damping must be at least"),
        (partial(lbt.models.PositionLoop, **forceless), "must follow its command"),
        (partial(shell().step_response, 1.0), "tolerance must be below 1"),
    ]
    require_refusals((call, lbt.errors.ProblemError, words) for call, words in rows)
