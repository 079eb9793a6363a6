"""Our gain files in pyRTC's own loop, its processes and its shared memory."""

from functools import cache

import numpy as np
import pytest
from support.exports import lbt_config, lbt_designs, relative
from support.gain_file_edits import odd_plant
from support.pyrtc_systems import (
    SENSOR_HZ,
    drawn,
    modal_residuals,
    pol_series,
    residual_rms,
    running,
    synthetic,
)

import lbt_synth as lbt
from lbt_synth.interop.pyrtc import plugin
from lbt_synth.interop.pyrtc.pol_filter import InnerLoop
from lbt_synth.loop.simulation.run import step_loop

QUIET = 5  # frames without a signal, until the loop runs
SETTLE = 500


@cache
def given():
    return drawn(lbt_config().truth, lbt_config().hardware, frames=2000, seed=2, quiet=QUIET)


def export(folder, name="kalman", **options):
    design = lbt.kalman(odd_plant()) if name == "odd" else lbt_designs()[name]
    lbt.interop.export_pyrtc(folder, design, **options)
    return design


def commands(controller, hardware):
    return step_loop(controller, 1.0, hardware, *given())


def test_only_the_loop_is_lent():
    with pytest.raises(AttributeError, match="no attribute Lop"):
        plugin.Lop  # noqa: B018


@pytest.mark.e2e
@pytest.mark.parametrize(("name", "own_process"), [("odd", False), ("hinf", True)])
def test_commands_are_those_of_the_controller(tmp_path, name, own_process):
    """To the last bit those of the twin, and to single precision ours."""
    pytest.importorskip("pyrtc")
    design = export(tmp_path, name)
    with running(tmp_path, own_process=own_process) as (telescope, _):
        found = commands(telescope, design.hardware)
    assert np.array_equal(found, commands(InnerLoop(design), design.hardware))
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
    pytest.importorskip("pyrtc")
    config, left = lbt_config(), {}
    design = export(tmp_path)
    training = pol_series(config.truth, config.hardware, frames=8000, seed=1)
    others = {kind: {"type": kind, "delay_frames": 2} for kind in ("ar_kalman", "least_squares")}
    for kind, predictor in {"ours": None, "fitted": None, **others}.items():
        fitted_to = None if kind == "ours" else training
        with running(tmp_path, predictor=predictor, training=fitted_to) as (telescope, loop):
            found = commands(telescope, design.hardware)
            assert loop.predictor_fitted == (kind != "ours")
        left[kind] = residual_rms(found[:, SETTLE:])
    assert left["ours"] < min(left["ar_kalman"], left["least_squares"])
    assert left["fitted"] < 0.5 * left["ours"]


@pytest.mark.e2e
def test_it_closes_on_the_sensor_of_pyrtc(tmp_path):
    """Its images, its slopes and its calibration, at its own pace."""
    pytest.importorskip("pyrtc")
    path = lbt.LoopHardware(frame_rate_hz=SENSOR_HZ, delay_frames=1)
    lbt.interop.export_pyrtc(tmp_path, lbt.integrator(path, gain=0.4), modes=6)
    config = tmp_path / "config.yaml"
    config.write_text(config.read_text().replace("other_gain: 0.0", "other_gain: 0.5"))

    def left():
        """Part of each mode that the closed loop leaves: about 0.2, if no frame is late."""
        with synthetic(tmp_path) as manager:
            open_loop = np.std(modal_residuals(manager, 120), axis=0)
            manager.start_component("loop")
            modal_residuals(manager, 50)  # until it has settled
            return np.std(modal_residuals(manager, 120), axis=0) / open_loop

    assert any(np.all(left() < 0.6) for _ in range(3))  # a busy machine may try again


@pytest.mark.e2e
def test_a_spoilt_frame_repeats_the_command_and_a_loop_that_stops_is_an_error(
    tmp_path, monkeypatch
):
    pytest.importorskip("pyrtc")
    export(tmp_path)
    with running(tmp_path) as (telescope, loop):
        for k in range(10):
            last = telescope.step([float(k), 1.0])
        assert np.any(last)
        assert np.array_equal(telescope.step([np.nan, 1.0]), last)
        loop.stop()
        telescope.step(np.zeros(2))  # the frame that it waits for
        monkeypatch.setattr(plugin, "_ANSWER_SECONDS", 0.1)
        with pytest.raises(lbt.errors.ProblemError, match="must answer within 0.1 s"):
            telescope.step(np.zeros(2))
