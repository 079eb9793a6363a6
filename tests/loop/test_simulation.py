"""Simulated loops against the loop equations and the exact residual."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.lqg import shell
from support.refusals import require_refusals
from support.sensor_loops import example_plant

import lbt_synth as lbt
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop.simulation import Drop, run_segments, step_response


@pytest.mark.parametrize(
    ("delay", "mirror"), [(1, None), (2.7, None), (2, shell(70, delay_samples=2))]
)
def test_fast_loop_is_the_loop_as_written(delay, mirror):
    rng = np.random.default_rng(2)
    matrices = {"sensor_matrix": (3, 2), "influence_matrix": (2, 4)}
    matrices = {name: rng.standard_normal(size) for name, size in matrices.items()}
    plant = example_plant((), delay_frames=delay, noise_nm=5, **matrices)
    path = replace(plant.hardware, mirror=mirror)
    leaky = lbt.design.IntegratorLaw(leak=0.98)
    design = lbt.integrator(path, gain=0.1, law=leaky) if mirror else lbt.kalman(plant)
    line = lbt.models.SinusoidalVibration(frequency_hz=24, rms_nm=90, direction=(1, 2))
    facts = {"noise_nm": 5, "sensor_gain": 0.9, "vibrations": (line,)}
    truth = lbt.Truth(turbulence=plant.turbulence, **facts)
    size = {"frames": 300, "cases": 2, "seed": 4, "settle_frames": 50}
    fast, stepped = (
        lbt.simulate(k, truth, hardware=path, **size)
        for k in (design.controller, design.controller.start())
    )
    for name in ("residual_nm", "commands", "measurements", "total_nm"):
        one, other = getattr(fast, name), getattr(stepped, name)
        assert np.allclose(one, other, atol=1e-9 * np.abs(other).max()), name


@pytest.mark.parametrize(("delay", "mirror", "frame_means"), [(2, None, True), (2.4, 70, False)])
def test_simulation_agrees_with_the_exact_answer(config, delay, mirror, frame_means):
    """Within the statistical error, which the scatter of independent runs gives."""
    moved = None if mirror is None else shell(mirror, delay_samples=2)
    path, truth = replace(config.hardware, delay_frames=delay, mirror=moved), config.truth
    controller = lbt.lqg(replace(config.plant, hardware=path), command_weight=1e-3).controller
    size = {"frames": 4000, "cases": 24, "seed": 3, "frame_means": frame_means}
    run = lbt.simulate(controller, truth, hardware=path, **size)
    loop = lbt.close_loop(path, controller)
    exact = lbt.residual_budget(loop, truth, frame_means=frame_means)
    variances, strehls = run.rms_nm**2, run.strehl(config.imaging)
    error, scatter = (x.std(ddof=1) / np.sqrt(len(x)) for x in (variances, strehls))
    assert abs(variances.mean() - exact.rms_nm**2) < 4 * error
    assert error < 0.04 * exact.rms_nm**2  # the test has teeth
    # the series' own mean is taken out of its image, which only helps
    assert abs(strehls.mean() - lbt.strehl(exact, config.imaging)) < 4 * scatter + 5e-4


def test_refusals(axis_plant, sensors_design, sensors_config):
    hardware, truth = axis_plant.hardware, lbt.Truth(turbulence=None, noise_nm=1)
    filters = lbt.kalman(axis_plant).controller
    line = lbt.models.SinusoidalVibration(frequency_hz=5, rms_nm=1)
    shaken = lbt.Truth(turbulence=None, vibrations=(line,))
    gain = lbt.linear.StateSpace(A=0.5, B=1.0, C=1.0, D=0.0)
    broken = SimpleNamespace(step=lambda _y: np.array([np.nan]), reset=lambda: None)
    turning = SimpleNamespace(step=lambda y: 1j * y, reset=broken.reset)

    def run(controller=filters, met=truth, **counts):
        facts = {"hardware": hardware, "frames": 10} | counts
        return lambda: lbt.simulate(controller, met, **facts)

    def fail(**facts):
        drop = {"unit": "m1", "start_s": 0} | facts
        return lambda: failing_run(sensors_design, sensors_config.truth, drop, frames=10)

    units = "called 'm3'; there are wavefront, slow, m1"
    rows = [
        (run(broken), ProblemError, "must return 1 finite commands"),
        (run(turning), ProblemError, "the controller's commands must be real"),
        (run(hardware=axis_plant), ProblemError, "must be a LoopHardware.* Try tiptiltplant.hard"),
        (run("controller"), ProblemError, r"step\(y\) and reset\(\)"),
        (run(frames=0), ProblemError, "frames must be"),
        (run(cases=0), ProblemError, "cases must be"),
        (run(seed=-1), ProblemError, "seed must be"),
        (run(settle_frames=-1), ProblemError, "settle_frames must be"),
        (run(frames=10**24), ProblemError, "must fit into 8 GB"),
        (run(frames=10**6, cases=10**6), ProblemError, "must fit into 8 GB"),
        (run(met=shaken), DimensionError, "must have 1 components"),
        (lambda: filter_series(gain, np.zeros((5, 2))), DimensionError, "inputs must be"),
        (lambda: filters.start().step([1.0, 2.0]), DimensionError, "y must have shape"),
        (lambda: step(0.3, axis=2), ProblemError, "axis must be below 2"),
        (fail(start_s=2, end_s=1), ProblemError, "must be back after it fails"),
        (fail(reading="odd"), ProblemError, "missing, zero, frozen"),
        (fail(start_s=-1), ProblemError, "at least 0"),
        (fail(unit="m3"), ProblemError, units),
    ]
    require_refusals(rows)


PATH = lbt.LoopHardware(frame_rate_hz=500)


def step(gain, **more):
    loop = lbt.close_loop(PATH, lbt.integrator(PATH, gain=gain).controller)
    return step_response(loop, **more)


def test_a_step_is_answered_frame_by_frame():
    answer = step(0.5)
    assert answer.time_s[:2] == pytest.approx([0, 0.002])
    # two frames pass before anything moves: y(1) sees the step, u(1) acts in frame 2
    expected, u = [1.0], [0.0]
    for k in range(1, 20):
        u.append(u[-1] + 0.5 * expected[k - 1])
        expected.append(1.0 - u[k - 1])
    assert answer.residual[:20] == pytest.approx(expected)
    assert answer.command[:20] == pytest.approx(u)
    assert answer.overshoot_percent == pytest.approx(-100 * min(expected))
    slow = step(0.1)
    after = round(slow.settling_s * 500)
    assert abs(slow.residual[after - 1]) > 0.05
    assert np.all(np.abs(slow.residual[after:]) <= 0.05)
    assert np.isnan(step(0.1, frames=5).settling_s)
    assert step(0.1, axis=1).residual == pytest.approx(slow.residual)


def failing_run(design, truth, *drops, frames=10_000):
    facts = {"cases": 2, "seed": 3, "hardware": design.hardware, "settle_frames": 1000}
    return lbt.simulate(design, truth, drops=[Drop(**x) for x in drops], frames=frames, **facts)


def test_the_wavefront_sensor_may_go_and_come_back(sensors_design, sensors_config):
    away = {"unit": "wavefront", "start_s": 3, "end_s": 3.2}
    run = failing_run(sensors_design, sensors_config.truth, away)
    untouched = failing_run(sensors_design, sensors_config.truth)
    apart = np.abs(run.residual_nm - untouched.residual_nm)
    assert not np.any(apart[:, :3000])
    assert np.max(apart[:, 3000:3200]) > 20
    assert np.max(apart[:, 9000:]) < 1e-6  # what it left has decayed
    steps = np.abs(np.diff(run.commands, axis=1))
    # no jump of the commands where filters are switched
    assert np.max(steps[:, 2998:3003]) < 2 * np.max(steps[:, :2990])


def test_segments_of_drops_that_overlap():
    drops = [Drop(unit="a", start_s=1, end_s=3), Drop(unit="b", start_s=2, reading="zero")]
    segments = [(s.start_s, s.end_s, s.text) for s in run_segments(drops, 4.0)]
    assert segments == [(0, 1, ""), (1, 2, "a"), (2, 3, "a, b (zero)"), (3, 4, "b (zero)")]
