"""Controllers rehearsed in the arithmetic of targets."""

from __future__ import annotations

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.interop.target import target_names
from lbt_synth.loop.simulation.run import filter_series

PATH = lbt.LoopHardware(frame_rate_hz=800)
PHASE = 100 * np.cumsum(np.random.default_rng(0).standard_normal((1500, 2)), axis=0) / 30


@pytest.fixture(scope="module")
def slow():
    return lbt.integrator(PATH, gain=0.4)


@pytest.mark.parametrize("name", target_names())
def test_each_target_runs_beside_the_design(slow, name):
    noise = np.random.default_rng(1).standard_normal((1500, 2))
    run = lbt.interop.rehearse(slow, name, PHASE, noise=noise, sensor_gain=0.8)
    loop = lbt.close_loop(PATH, slow, sensor_gain=0.8)
    exact = filter_series(loop.system, np.hstack([PHASE, noise]))[run.settle_frames :]
    assert np.allclose(run.design.residual_nm, exact[:, :2], atol=1e-9)
    assert np.allclose(run.design.commands, exact[:, 2:4], atol=1e-9)
    assert run.spectral_radius == loop.spectral_radius
    single = name in ("cacao", "dao", "pyrtc")
    largest = np.max(np.abs(run.differences))
    assert (largest > 1e-9) == single
    assert largest < (0.01 if name != "cacao" else 1.0) * np.max(np.abs(PHASE))
    assert run.target.clipped_frames == run.design.clipped_frames == 0


@pytest.mark.parametrize("name", ["cacao", "dao", "pyrtc"])
def test_a_target_that_knows_its_limit_comes_back(slow, name):
    """After a step beyond the stroke, the residual is what it was before."""
    phase = np.zeros((1200, 2))
    phase[300:600] = 100.0
    run = lbt.interop.rehearse(slow, name, phase, stroke=50.0)
    start = run.settle_frames
    assert np.max(np.abs(run.target.commands)) == 50
    assert 0 < run.target.clipped_frames <= 300
    assert run.design.clipped_frames > 500  # the plain form winds up
    back = run.target.residual_nm[600 - start :]
    assert np.max(np.abs(back[40:])) < 0.5


def with_runner(monkeypatch, runner):
    """Give C another runner."""
    target = lbt.interop.Target(
        arithmetic=lbt.interop.target_named("c").arithmetic, file="", write=print, runner=runner
    )
    monkeypatch.setattr("lbt_synth.interop.c.export.TARGET", target)


def test_a_loop_that_the_target_makes_unstable_is_named(slow, monkeypatch):
    wrong = lbt.Controller(
        A=np.eye(2), B=-0.4 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=PATH.dt_s
    )
    with_runner(monkeypatch, lambda design, limit: wrong.start())
    with pytest.raises(lbt.errors.NumericalError, match="of c the loop grows beyond all numbers"):
        lbt.interop.rehearse(slow, "c", np.vstack([PHASE] * 3))


def test_what_cannot_be_rehearsed_is_refused(slow, monkeypatch):
    problem = lbt.errors.ProblemError
    with pytest.raises(lbt.errors.DimensionError, match=r"\(frames, 2\)"):
        lbt.interop.rehearse(slow, "dao", PHASE[:, :1])
    with pytest.raises(problem, match="sensor_gain must be above 0"):
        lbt.interop.rehearse(slow, "dao", PHASE, sensor_gain=0.0)
    with pytest.raises(lbt.errors.UnstableLoopError):
        lbt.interop.rehearse(slow, "dao", PHASE, sensor_gain=4.0)
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    with pytest.raises(problem, match="bare controller"):
        lbt.interop.rehearse(bare, "dao", PHASE)
    with_runner(monkeypatch, None)
    with pytest.raises(problem, match="take one of cacao, dao, iir"):
        lbt.interop.rehearse(slow, "c", PHASE)
