"""What can be moved, and in which range."""

import numpy as np
import pytest
from support.configs import change_key, write_config
from support.explore import five_lines
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.report.explore.exploration import Wish, fulfil
from lbt_synth.report.explore.knobs import list_knobs, shift_range_hz


def test_the_knobs_of_a_configuration(tmp_path):
    config = lbt.load_config(write_config(tmp_path, five_lines()))
    knobs = {knob.key: knob for knob in list_knobs(config)}
    loop = [key for key, knob in knobs.items() if knob.methods is None]
    assert loop == ["delay", "gain", "noise", "shift", "seeing", "wind"]
    assert knobs["hinf-gamma_ratio"].methods == {"hinf"}
    assert knobs["spread"].methods == {"hinf", "kalman", "lqg", "mixed"}
    assert (knobs["robust-modulus_margin"].low, knobs["robust-modulus_margin"].value) == (0.2, 0.45)
    assert knobs["wind"].value == 20.0
    assert knobs["noise"].value == pytest.approx(config.noise_nm)
    for knob in knobs.values():
        assert knob.low <= knob.value <= knob.high
        assert knob.low > 0 or not knob.log


def test_what_a_configuration_does_not_have_cannot_be_moved(tmp_path):
    content = change_key(("truth", "vibrations"), [])
    del content["model"]["vibrations"], content["atmosphere"], content["end_to_end"]
    content["model"]["turbulence"] = {"kind": "ar", "coefficients": [0.99], "driving_rms_nm": 9.0}
    content["truth"]["turbulence"] = "model"
    config = lbt.load_config(write_config(tmp_path, content))
    loop = [knob.key for knob in list_knobs(config) if knob.methods is None]
    assert loop == ["delay", "gain", "noise"]
    assert shift_range_hz(config) == (0.0, 0.0)
    assert not any(knob.key.startswith("robust") for knob in list_knobs(config))


def test_the_range_of_frequency_errors(tmp_path):
    content = change_key(("truth", "vibrations", 0, "frequency_hz"), 1.0)
    config = lbt.load_config(write_config(tmp_path, content))
    low, high = shift_range_hz(config)
    assert -1.0 < low < -0.5  # it stays above 0
    assert high == 3.5
    content["truth"]["vibrations"][0] |= {"frequency_hz": 20.0, "frequency_error_hz": 2.0}
    del content["robustness"]["errors_hz"]
    config = lbt.load_config(write_config(tmp_path, content))
    assert shift_range_hz(config) == pytest.approx((-2.0, 2.0))


@pytest.mark.parametrize("example", ["lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"])
def test_a_knob_at_its_value_changes_nothing(example):
    config = lbt.load_config(ROOT / "examples" / example)
    knobs = list_knobs(config)
    for name in ("kalman", "robust"):
        here = {
            knob.key: knob.value for knob in knobs if knob.methods is None or name in knob.methods
        }
        moved, _ = fulfil(Wish(method=name, values=here), knobs, config)
        for matrix in "ABCDL":
            ours, theirs = getattr(moved.plant, matrix), getattr(config.plant, matrix)
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
        assert moved.hardware.delay_frames == config.hardware.delay_frames
        assert moved.truth.sensor_gain == pytest.approx(config.truth.sensor_gain, rel=1e-12)
        assert moved.truth.noise_nm == pytest.approx(config.truth.noise_nm, rel=1e-12)
        for ours, theirs in zip(moved.truth.vibrations, config.truth.vibrations, strict=True):
            assert ours.frequency_hz == theirs.frequency_hz
            assert ours.rms_nm == pytest.approx(theirs.rms_nm, rel=1e-12)
            assert ours.direction == pytest.approx(theirs.direction, abs=1e-12)
