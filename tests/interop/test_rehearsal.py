"""Controllers rehearsed in the arithmetic of targets."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.recorded_runs import recorded_run
from support.sensor_loops import SLOW, example_plant

import lbt_synth as lbt
from lbt_synth.interop.cacao.export import predictive_filter
from lbt_synth.interop.pipeline import target_named, target_names
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop import Disturbance

pytestmark = pytest.mark.usefixtures("short_rehearsal")
PATH = lbt.LoopHardware(frame_rate_hz=800)
PHASE = 100 * np.cumsum(np.random.default_rng(0).standard_normal((1500, 2)), axis=0) / 30


@pytest.fixture(scope="module")
def slow():
    return lbt.integrator(PATH, gain=0.4)


@pytest.mark.parametrize("name", target_names())
def test_each_target_runs_beside_the_design(slow, name):
    noise = np.random.default_rng(1).standard_normal((1500, 2))
    run = lbt.interop.rehearse(
        slow, name, Disturbance(phase_nm=PHASE, noise=noise, sensor_gain=0.8)
    )
    loop = lbt.close_loop(PATH, slow, sensor_gain=0.8)
    exact = filter_series(loop.system, np.hstack([PHASE, noise]))[run.settle_frames :]
    assert np.allclose(run.design.residual_nm[0], exact[:, :2], atol=1e-9)
    assert np.allclose(run.design.commands[0], exact[:, 2:4], atol=1e-9)
    assert run.checks[0].name.startswith("spectral radius at sensor gains")
    assert all(check.passed for check in run.checks)
    single = name in ("cacao", "dao", "pyrtc")
    largest = np.max(np.abs(run.differences))
    assert (largest > 1e-9) == single
    assert largest < (0.01 if name != "cacao" else 1.0) * np.max(np.abs(PHASE))
    assert run.clipped_frames(run.target) == run.clipped_frames(run.design) == 0


@pytest.mark.parametrize("name", ["cacao", "dao", "pyrtc"])
def test_a_target_that_knows_its_limit_comes_back(slow, name):
    """After a step beyond the stroke, the residual is what it was before."""
    phase = np.zeros((1200, 2))
    phase[300:600] = 100.0
    run = lbt.interop.rehearse(slow, name, Disturbance(phase_nm=phase), stroke=50.0)
    start = run.settle_frames
    assert np.max(np.abs(run.target.commands)) == 50
    assert 0 < run.clipped_frames(run.target) <= 300
    assert run.clipped_frames(run.design) > 500  # the plain form winds up
    back = run.target.residual_nm[0, 600 - start :]
    assert np.max(np.abs(back[40:])) < 0.5


@pytest.fixture(scope="module")
def quick():
    """A design whose filter is short."""
    air = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=40.0, frame_rate_hz=800)
    line = lbt.Vibration(frequency_hz=60, damping=0.2, rms_nm=200.0, direction=(1.0,))
    models = {"turbulence": air, "vibrations": [line], "noise_nm": 15.0}
    plant = lbt.tip_tilt_plant(frame_rate_hz=800, modes=1, **models)
    return lbt.hinf(plant, gamma_ratio=1.1, route="riccati")


@pytest.mark.parametrize("name", target_names())
def test_what_runs_is_what_is_exported(tmp_path, quick, name):
    target, total = target_named(name), PHASE[:600, :1]
    written = lbt.interop.export(target.path_in(tmp_path), quick, name)
    rest = np.zeros(total.shape)
    alone = recorded_run(written.start(60.0), quick.hardware, total, rest, stroke=60.0)[0]
    run = lbt.interop.rehearse(quick, name, Disturbance(phase_nm=total), stroke=60.0)
    assert np.array_equal(run.target.commands[0], alone[run.settle_frames :, 1:2])
    assert [check.value for check in run.checks] == [check.value for check in written.checks]
    if name == "cacao":
        steps = json.loads(written.files[1].read_text())["steps"]
        assert steps == predictive_filter(quick).fewest_steps(0.01)


def test_a_loop_that_the_target_makes_unstable_is_named(tmp_path, slow, monkeypatch):
    wrong = lbt.Controller(
        A=np.eye(2), B=-0.4 * np.eye(2), C=np.eye(2), D=np.zeros((2, 2)), dt_s=PATH.dt_s
    )
    found = lbt.interop.export(tmp_path / "k.c", slow, "c")
    broken = replace(found, start=lambda _: wrong.start())
    monkeypatch.setattr("lbt_synth.interop.rehearsal.export", lambda *_: broken)
    with pytest.raises(lbt.errors.NumericalError, match="of c the loop grows beyond all numbers"):
        lbt.interop.rehearse(slow, "c", Disturbance(phase_nm=np.vstack([PHASE] * 3)))


def test_what_cannot_be_rehearsed_is_refused(slow):
    bare = lbt.kalman(lbt.EstimationProblem(A=0.5, B=[[1, 0]], C=1, D=[[0, 1]], L=1))
    several = lbt.kalman(example_plant((SLOW,)))
    problem = lbt.errors.ProblemError
    series, strong = (Disturbance(phase_nm=PHASE, sensor_gain=gain) for gain in (1.0, 4.0))
    narrow = Disturbance(phase_nm=PHASE[:, :1])
    for given, error, words in (
        ((slow, "dao", narrow), lbt.errors.DimensionError, r"\(frames, 2\)"),
        ((slow, "dao", PHASE), problem, "disturbance must be a Disturbance"),
        ((slow, "dao", strong), lbt.errors.UnstableLoopError, None),
        ((bare, "dao", series), problem, "bare estimation problem"),
        ((several, "c", series), problem, "got one of several sensors"),
    ):
        with pytest.raises(error, match=words):
            lbt.interop.rehearse(*given)
