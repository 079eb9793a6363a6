"""Loops that are held for a while, and records of commands that stop while the loop runs."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.identification.commands.held_commands import held_while_moving

RATE_HZ, FRAMES = 800.0, 8000
HELD = np.arange(FRAMES) // 2000 % 2 == 1


def run_loop(held, *, sensor_gain=1.0, seed=0):
    """An integrator on a drift, frame by frame; it stands still where it is held."""
    rng = np.random.default_rng(seed)
    phi, y, u = np.zeros((3, FRAMES, 2))
    for k in range(1, FRAMES):
        phi[k] = 0.99 * phi[k - 1] + 15 * rng.standard_normal(2)
        corrected = u[k - 2] if k > 1 else 0
        y[k] = sensor_gain * (phi[k - 1] - corrected) + 10 * rng.standard_normal(2)
        u[k] = u[k - 1] if held[k] else u[k - 1] + 0.3 * y[k]
    return y, u


def record_of(y, u):
    return lbt.identification.loop_record(
        y, u, frame_rate_hz=RATE_HZ, delay_frames=2, unit="nm", diameter_m=8.22
    )


@pytest.mark.parametrize("sensor_gain", [0.5, 1.0])
def test_a_loop_that_was_held_is_a_good_record(sensor_gain):
    record = record_of(*run_loop(HELD, sensor_gain=sensor_gain))
    assert held_while_moving(record) == ""
    assert lbt.identification.explain_commands(record).accepted


@pytest.mark.parametrize("sensor_gain", [0.5, 1.0])
@pytest.mark.parametrize("axes", [[0], [0, 1]])
def test_a_record_of_the_commands_that_stops_is_refused(sensor_gain, axes):
    y, u = run_loop(np.zeros(FRAMES, dtype=bool), sensor_gain=sensor_gain)
    for k in np.flatnonzero(HELD):
        u[k, axes] = u[k - 1, axes]
    verdict = lbt.identification.explain_commands(record_of(y, u))
    assert not verdict.accepted
    assert "they stand still in 50 % of the frames" in verdict.explanation


def test_short_stretches_are_not_judged():
    y, u = run_loop(np.zeros(FRAMES, dtype=bool))
    u[1000:1200] = u[1000]
    assert held_while_moving(record_of(y, u)) == ""
