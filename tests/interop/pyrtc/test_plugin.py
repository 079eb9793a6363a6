"""Our predictor without pyRTC, in pyRTC's own loop, and beside its own predictors."""

from functools import partial

import numpy as np
import pytest
from support import pyrtc_systems as systems
from support.exports import lbt_config, lbt_designs, relative
from support.gain_files import odd_plant
from support.recorded_runs import recorded_run
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.interop.pyrtc import plugin
from lbt_synth.interop.pyrtc.export import InnerLoop, pol_filter
from lbt_synth.interop.pyrtc.plugin import GainFilePredictor

QUIET = 5  # frames without a signal, until the loop runs
SETTLE = 500


def export(folder, name="kalman", **options):
    design = lbt.kalman(odd_plant()) if name == "odd" else lbt_designs()[name]
    lbt.interop.export(folder, design, "pyrtc", **options)
    return design


def commands(controller, hardware):
    config = lbt_config()
    series = systems.drawn(config.truth, config.hardware, frames=2000, seed=2, quiet=QUIET)
    return recorded_run(controller, hardware, *series)


@pytest.mark.e2e
@pytest.mark.parametrize(("name", "own_process"), [("odd", False), ("hinf", True)])
def test_commands_are_those_of_the_controller(tmp_path, name, own_process):
    """To the last bit those of the twin, and to single precision ours."""
    design = export(tmp_path, name)
    with systems.running(tmp_path, own_process=own_process) as (telescope, _):
        found = commands(telescope, design.hardware)
    assert np.array_equal(found, commands(InnerLoop(pol_filter(design)), design.hardware))
    own = commands(design.controller.start(), design.hardware)
    assert relative(found[..., 2:4], own[..., 2:4]) < 1e-6


@pytest.mark.e2e
def test_pyrtc_finds_nothing_to_say_about_the_configuration(tmp_path):
    pytest.importorskip("pyrtc")
    from pyrtc.config_schema import collect_config_warnings, read_system_config

    export(tmp_path, modes=3)
    read = read_system_config(tmp_path / "config.yaml")
    assert collect_config_warnings(read) == []
    assert read["loop"]["predictor"]["gain_file"] == str(tmp_path / "gain.fits")


@pytest.mark.e2e
def test_the_residual_is_below_those_of_its_own_predictors(tmp_path):
    config, left = lbt_config(), {}
    design = export(tmp_path)
    training = sum(systems.drawn(config.truth, config.hardware, frames=8000, seed=1))[0]
    others = {kind: {"type": kind, "delay_frames": 2} for kind in ("ar_kalman", "least_squares")}
    for kind, predictor in {"ours": None, **others}.items():
        options = {"predictor": predictor, "training": None if kind == "ours" else training}
        with systems.running(tmp_path, **options) as (telescope, loop):
            found = commands(telescope, design.hardware)
            assert loop.predictor_fitted == (kind != "ours")
        left[kind] = np.sum(np.var(found[0, SETTLE:, :2], axis=0))
    assert left["ours"] < min(left["ar_kalman"], left["least_squares"])


@pytest.mark.e2e
def test_it_closes_on_the_sensor_of_pyrtc(tmp_path):
    """Its images, its slopes and its calibration, at its own pace."""
    path = lbt.LoopHardware(frame_rate_hz=systems.SENSOR_HZ, delay_frames=1)
    lbt.interop.export(tmp_path, lbt.integrator(path, gain=0.4), "pyrtc", modes=6)
    config = tmp_path / "config.yaml"
    config.write_text(config.read_text().replace("other_gain: 0.0", "other_gain: 0.5"))

    def left():
        """Part of each mode that the closed loop leaves: about 0.2, if no frame is late."""
        with systems.synthetic(tmp_path) as manager:
            open_loop = np.std(systems.modal_residuals(manager, 120), axis=0)
            manager.start_component("loop")
            systems.modal_residuals(manager, 50)  # until it has settled
            return np.std(systems.modal_residuals(manager, 120), axis=0) / open_loop

    assert any(np.all(left() < 0.6) for _ in range(3))  # a busy machine may try again


@pytest.mark.e2e
def test_a_spoilt_frame_repeats_the_command_and_a_loop_that_stops_is_an_error(
    tmp_path, monkeypatch
):
    export(tmp_path)
    with systems.running(tmp_path) as (telescope, loop):
        for k in range(10):
            last = telescope.step([float(k), 1.0])
        assert np.any(last)
        assert np.array_equal(telescope.step([np.nan, 1.0]), last)
        loop.stop()
        telescope.step(np.zeros(2))  # the frame that it waits for
        monkeypatch.setattr(plugin, "_ANSWER_SECONDS", 0.1)
        with pytest.raises(lbt.errors.ProblemError, match="must answer within 0.1 s"):
            telescope.step(np.zeros(2))


LAZY = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500, modes=1), gain=0.5)


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gains")
    for name in ("kalman", "integrator"):
        lbt.save_gain(folder / f"{name}.fits", lbt_designs()[name])
    lbt.save_gain(folder / "lazy.fits", LAZY)
    return folder


def run(predictor, series):
    out = []
    for pol in series:
        predictor.update(pol)
        out.append(predictor.predict())
    return np.array(out)


def test_it_predicts_as_the_filter_after_the_frames_of_the_delay(gains):
    series = np.random.default_rng(0).standard_normal((200, 2)).astype(np.float32)
    predictor = GainFilePredictor(2, gain_file=gains / "kalman.fits")
    for _ in range(2):  # reset brings back the start
        running = InnerLoop(pol_filter(lbt_designs()["kalman"]))
        own = np.array([running.step_pol(pol.astype(float)) for pol in series])
        found = run(predictor, series)
        assert np.array_equal(found[2:], own[2:])
        assert not np.any(found[:2])
        predictor.reset()


def test_a_value_that_is_not_finite_repeats_the_last_command(gains):
    series = np.random.default_rng(0).standard_normal((50, 2))
    spoilt = np.insert(series, 20, [np.nan, 1.0], axis=0)
    clean, other = (
        run(GainFilePredictor(2, gain_file=gains / "kalman.fits"), s) for s in (series, spoilt)
    )
    assert np.array_equal(other[20], clean[19])
    assert np.array_equal(np.delete(other, 20, axis=0), clean)


def test_further_modes_have_an_integrator_and_all_are_clipped(gains):
    predictor = GainFilePredictor(2, gain_file=gains / "lazy.fits", other_gain=0.25)
    # the residual is what pyRTC adds less: 1, 1, 1 - 0.25, 1 - 0.5
    assert run(predictor, np.ones((6, 2)))[:, 1].tolist() == [0, 0, 0.25, 0.5, 0.6875, 0.8125]
    held = GainFilePredictor(2, gain_file=gains / "lazy.fits", command_limit=0.75)
    assert run(held, np.ones((4, 2))).tolist() == [[0, 0], [0, 0], [0.75, 0], [0.75, 0]]


def test_what_does_not_fit_is_refused(gains):
    slow = {"gain_file": gains / "integrator.fits"}
    lazy = GainFilePredictor(1, gain_file=gains / "lazy.fits")
    make, problem = partial(GainFilePredictor, **slow), lbt.errors.ProblemError
    rows = [
        (partial(make, 2, 3), problem, "predictor.delay_frames must be 2, that of"),
        (partial(make, 1), problem, "must control at least the 2 modes of"),
        (partial(make, 2, other_gain=-0.5), problem, "predictor.other_gain must be at least 0"),
        (partial(make, 2, command_limit=0), problem, "predictor.command_limit must be above 0"),
        (partial(lazy.fit, np.zeros((9000, 1))), problem, "not change while the loop runs"),
        (partial(getattr, plugin, "Lop"), AttributeError, "no attribute Lop"),
        (partial(make, 3, other_gain=1.5), lbt.errors.CertificateError, "closed loop"),
    ]
    require_refusals(rows)
    assert not lazy.fitted
