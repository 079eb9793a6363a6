"""The twin of pyRTC's loop."""

from __future__ import annotations

import numpy as np
import pytest
from support.exports import lbt_designs, relative
from support.gain_file_edits import odd_plant

import lbt_synth as lbt
from lbt_synth.interop.pyrtc.inner_loop import InnerLoop
from lbt_synth.loop.simulation.run import step_loop


def series(design, frames, seed=0):
    rng = np.random.default_rng(seed)
    total = np.cumsum(5 * rng.standard_normal((1, frames, design.hardware.modes)), axis=1)
    return total, 10 * rng.standard_normal((1, frames, design.hardware.modes))


@pytest.mark.parametrize("name", ["kalman", "hinf", "integrator", "odd"])
def test_its_commands_are_those_of_the_controller(name):
    design = lbt.kalman(odd_plant()) if name == "odd" else lbt_designs()[name]
    given = series(design, 1000)
    own, twin = (
        step_loop(one, 1.0, design.hardware, *given)[0, :, 2:4]
        for one in (design.controller.start(), InnerLoop(design))
    )
    assert 0 < relative(twin, own) < 1e-6
    assert np.array_equal(twin, twin.astype(np.float32))


def test_a_clipped_command_winds_nothing_up():
    design = lbt_designs()["kalman"]
    total, noise = series(design, 3000)
    total[:, 500:1000] += 1e5  # far beyond the stroke
    free, held = (
        step_loop(InnerLoop(design, limit), 1.0, design.hardware, total, noise)[0, :, :2]
        for limit in (np.inf, 500.0)
    )
    assert np.max(np.abs(held[600:1000])) > 9e4
    assert np.max(np.abs(held - free)[1600:]) < 1.0
    alone = design.controller.start()
    for y in held[500:1000]:
        alone.step(y)
    assert np.max(np.abs(alone.state)) > 1e8


def test_a_loop_that_was_open_closes_as_if_it_had_not_been():
    """The mirror is flattened while the loop does not run."""
    design, frames = lbt_designs()["kalman"], 2500
    total, noise = series(design, frames)
    whole = step_loop(InnerLoop(design), 1.0, design.hardware, total, noise)[0, :, :2]
    loop, commands, residual = InnerLoop(design), np.zeros((2, 2)), np.zeros(2)
    for k in range(frames):
        closed = not 500 <= k < 800
        commands = np.vstack(
            [loop.step(residual + noise[0, k]) if closed else np.zeros(2), commands[:1]]
        )
        residual = total[0, k] - commands[1]
        if k > 1500:
            assert np.max(np.abs(residual - whole[k])) < 0.5


def test_reset_forgets():
    loop = InnerLoop(lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.5))
    assert [loop.step([2.0])[0] for _ in range(2)] == [1.0, 2.0]
    loop.reset()
    assert loop.step([2.0])[0] == 1.0
