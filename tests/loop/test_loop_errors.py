"""Boxes of gains and delays that are proved, against the poles of loops inside and outside."""

from dataclasses import replace

import numpy as np
import pytest
from support.lqg import shell
from support.plants import lbt_axis_plant

import lbt_synth as lbt
from lbt_synth.loop.loop_errors import (
    FRAGILE_DB,
    FRAGILE_FRAMES,
    append_taps,
    errors_together,
    loop_changes,
)


def two_axes(delay):
    """A plant whose axes share a line, and whose sensor sees both."""
    return lbt.tip_tilt_plant(
        frame_rate_hz=800,
        delay_frames=delay,
        turbulence=lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=30, frame_rate_hz=800),
        noise_nm=10.0,
        vibrations=[lbt.Vibration(frequency_hz=25, damping=0.02, rms_nm=100, direction=(1, 0.7))],
        sensor_matrix=[[0.9, 0.2], [-0.1, 1.1]],
    )


def is_stable(hardware, controller, gain, delay):
    path = replace(hardware, delay_frames=delay)
    return lbt.close_loop(path, controller, sensor_gain=gain).is_stable


LOOPS = {
    "kalman": lambda: lbt.kalman(lbt_axis_plant()),
    "kalman at a fraction": lambda: lbt.kalman(
        replace(
            lbt_axis_plant(),
            hardware=lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=2.49),
        )
    ),
    "two axes": lambda: lbt.hinf(two_axes(2.3), gamma_ratio=1.2),
    "integrator": lambda: lbt.integrator(lbt.LoopHardware(frame_rate_hz=800, modes=1), gain=0.8),
    "one frame": lambda: lbt.integrator(
        lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=1), gain=0.8
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_every_loop_within_the_errors_is_stable(name):
    design = LOOPS[name]()
    path = design.hardware
    scale = errors_together(lbt.close_loop(path, design))
    assert scale > 0.1
    rng = np.random.default_rng(0)
    late, factor = scale * FRAGILE_FRAMES, 10 ** (scale * FRAGILE_DB / 20)
    signs = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    for a, b in [*signs, *rng.uniform(-1, 1, (60, 2)).tolist()]:
        delay = max(path.delay_frames + a * late, 1.0)
        assert is_stable(path, design.controller, factor**b, delay), (a, b)
    # beyond, the proof is not far from the truth
    wide = [
        is_stable(path, design.controller, factor ** (2.5 * b), path.delay_frames + 2.5 * a * late)
        for a, b in signs
        if path.delay_frames + 2.5 * a * late >= 1
    ]
    assert not all(wide)


def test_a_gain_alone_has_the_exact_interval():
    """Of an integrator without an error of the delay: 1 / 0.8 at two frames."""
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    loop = lbt.close_loop(path, lbt.integrator(path, gain=0.8))
    low, high = lbt.loop.stable_sensor_gains(path, loop.controller)
    assert (low, high) == (0.0, pytest.approx(1.25, rel=1e-6))
    changes = loop_changes(path, low=1.0, high=high * 0.999, delay_frames=0.0)
    assert [(gain, delay) for gain, delay, _ in changes] == [(high * 0.999, 2.0)]
    ((*_, taps),) = changes
    np.testing.assert_allclose(taps, [0, 0, 1 - high * 0.999])


def test_loops_that_stand_for_all_are_the_corners_and_whole_delays():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=2.9)
    changes = loop_changes(path, low=0.5, high=1.5, delay_frames=0.3)
    assert {(gain, round(delay, 9)) for gain, delay, _ in changes} == {
        (g, d) for g in (0.5, 1.5) for d in (2.6, 3.0, 3.2)
    }
    assert not loop_changes(path, low=1.0, high=1.0, delay_frames=0.0)
    short = lbt.LoopHardware(frame_rate_hz=800, modes=1, delay_frames=1.0)
    delays = {delay for _, delay, _ in loop_changes(short, low=1, high=1, delay_frames=0.5)}
    assert delays == {1.5}  # none is below one frame


def test_taps_behind_several_outputs():
    rng = np.random.default_rng(1)
    system = lbt.linear.StateSpace(
        A=0.3 * rng.standard_normal((3, 3)),
        B=rng.standard_normal((3, 2)),
        C=rng.standard_normal((2, 3)),
        D=rng.standard_normal((2, 2)),
        dt_s=1 / 800,
    )
    taps, f = np.array([0.0, 0.5, -0.2]), np.array([3.0, 77.0, 390.0])
    turn = np.exp(-2j * np.pi * f / 800)
    expected = (turn[:, None] ** np.arange(3) @ taps)[:, None, None] * system.frequency_response(f)
    np.testing.assert_allclose(append_taps(system, taps).frequency_response(f), expected)


def test_a_mirror_with_dynamics_has_no_answer():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1, mirror=shell(100, delay_samples=2))
    assert np.isnan(errors_together(lbt.close_loop(path, lbt.integrator(path, gain=0.1))))
