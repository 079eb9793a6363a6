"""What can be moved, and in which range."""

import numpy as np
import pytest
from support.configs import AR, change_key, write_config
from support.explore import five_lines
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.report.explore.exploration import fulfil
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
        moved, _ = fulfil(name, here, knobs, config)
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


def moved(config, method="kalman", **values):
    values = {key.replace("__", "-"): value for key, value in values.items()}
    return fulfil(method, values, list_knobs(config), config)[0]


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return lbt.load_config(write_config(tmp_path_factory.mktemp("five"), five_lines()))


def frequencies(lines):
    return [line.frequency_hz for line in lines]


def test_a_shift_moves_the_truth_alone(config):
    after = moved(config, shift=2.5)
    assert frequencies(after.plant.vibrations) == frequencies(config.plant.vibrations)
    expected = frequencies(config.truth.with_frequency_error(2.5).vibrations)
    assert frequencies(after.truth.vibrations) == pytest.approx(expected)


def test_lines_that_stay_stay(tmp_path):
    content = five_lines()
    content["model"]["vibrations"][1]["frequency_error_percent"] = 10.0
    config = lbt.load_config(write_config(tmp_path, content))
    after = moved(config, shift=1.0)
    places = sorted(set(frequencies(after.truth.vibrations)))
    assert places == pytest.approx([13.0, 21.0, 33.0, 48.0, 72.5])
    assert after.truth.frequency_errors_hz == pytest.approx(config.truth.frequency_errors_hz)


@pytest.mark.parametrize(("key", "value"), [("damping", 0.02), ("spread", 2.0)])
def test_what_is_assumed_leaves_the_truth(config, key, value):
    after = moved(config, **{key: value})
    for ours, theirs in zip(after.truth.vibrations, config.truth.vibrations, strict=True):
        assert (ours.frequency_hz, ours.damping) == (theirs.frequency_hz, theirs.damping)
        assert ours.direction == pytest.approx(theirs.direction, abs=1e-12)
    if key == "damping":
        assert [line.damping for line in after.plant.vibrations] == pytest.approx([0.02] * 10)
    else:
        assert len(after.plant.vibrations) == 5 * len(config.plant.vibrations)
        assert min(frequencies(after.plant.vibrations)) == pytest.approx(13 - 2 * 0.8)


def test_a_spread_can_be_taken_back(tmp_path):
    content = change_key(("model", "vibrations", 0, "spread_hz"), 1.0)
    content["model"]["vibrations"][0]["lines"] = 3
    config = lbt.load_config(write_config(tmp_path, content))
    assert len(config.plant.vibrations) == 6
    assert len(moved(config, spread=0.0).plant.vibrations) == 2


def test_the_loop_and_the_sky(config):
    after = moved(config, delay=3.25, gain=0.5, noise=40.0, seeing=1.1, wind=31.0)
    assert after.hardware.delay_frames == 3.25
    assert after.truth.sensor_gain == 0.5
    assert after.noise_nm == pytest.approx(40.0)
    assert (after.atmosphere.seeing_arcsec, after.atmosphere.wind_speed_m_s) == (1.1, 31.0)


def test_several_values_keep_their_proportions(tmp_path):
    content = change_key(("sensor",), {"noise_nm": [30.0, 40.0]})
    content["model"] |= {"turbulence": AR, "sensor_gain": [0.5, 0.7]}
    content["truth"] |= {"turbulence": "model", "sensor_gain": [0.25, 0.35]}
    config = lbt.load_config(write_config(tmp_path, content))
    after = moved(config, noise=np.sqrt(5000.0), gain=0.6)
    np.testing.assert_allclose(after.noise_nm, [60.0, 80.0])
    assert after.settings.truth.sensor_gain == pytest.approx([0.5, 0.7])
    assert after.truth.sensor_gain == pytest.approx(1.0)


def test_bands_widen_around_their_middles(config):
    before = moved(config, "robust")
    bands = before.method_section("robust").bands
    half = np.mean([band.high_hz - band.low_hz for band in bands]) / 2
    after = moved(config, "robust", robust__band=2 * half, robust__modulus_margin=0.3)
    section = after.method_section("robust")
    assert section.modulus_margin == 0.3
    for ours, theirs in zip(section.bands, bands, strict=True):
        assert ours.low_hz + ours.high_hz == pytest.approx(theirs.low_hz + theirs.high_hz)
        width = theirs.high_hz - theirs.low_hz
        assert ours.high_hz - ours.low_hz == pytest.approx(2 * width)
