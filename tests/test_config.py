"""Configuration files: what is read, and what is refused with the path of its key."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from plants import LBT_YAML
from ruamel.yaml import YAML

import lbt_synth as lbt

GOOD = YAML(typ="safe", pure=True).load(LBT_YAML.read_text())


def write(tmp_path, content):
    path = tmp_path / "c.yaml"
    if isinstance(content, str):
        path.write_text(content)
    else:
        with path.open("w") as stream:
            YAML(typ="safe", pure=True).dump(content, stream)
    return path


def changed(path, value):
    """A copy of the good file with one key set (or taken away, with ``...``)."""
    out = copy.deepcopy(GOOD)
    here = out
    *steps, last = path
    for step in steps:
        here = here[step]
    if value is ...:
        del here[last]
    else:
        here[last] = value
    return out


def test_the_example_is_the_papers_table_i(config):
    s = config.settings
    assert (s.telescope.diameter_m, s.telescope.obstruction) == (8.22, 0.11)
    assert (s.atmosphere.seeing_arcsec, s.atmosphere.outer_scale_m) == (0.8, 22)
    assert s.atmosphere.wind_speed_m_s == 20
    pyramid = s.sensor.pyramid
    assert (pyramid.wavelength_um, pyramid.modulation_lambda_over_d) == (0.75, 4)
    assert (pyramid.subapertures_across, pyramid.photons) == (30, 50)
    assert pyramid.read_noise_electrons == 8
    assert s.mirror.modes == 672
    assert (s.loop.frame_rate_hz, s.loop.delay_frames) == (800, 2)
    assert config.noise_nm == pytest.approx(15.6, abs=0.1)
    assert config.plant.vibrations[0].rms_nm == pytest.approx(797, abs=0.1)
    assert config.plant.turbulence[0].coefficients[0] == pytest.approx(0.98860, abs=5e-6)


@pytest.mark.parametrize(
    ("path", "value", "key", "text"),
    [
        (("telescope", "diameter_mm"), 8220, "telescope.diameter_mm", "did you mean diameter_m?"),
        (("loop", "frame_rate_khz"), 0.8, "loop.frame_rate_khz", "did you mean frame_rate_hz?"),
        (("model", "vibrations", 0, "rms_um"), 1, "model.vibrations[0].rms_um", "did you mean"),
        (("weather",), {}, "weather", "known are"),
        (("loop", "frame_rate_hz"), ..., "loop.frame_rate_hz", "is missing"),
        (("atmosphere",), ..., "atmosphere", "is missing"),
        (("model", "turbulence", "kind"), "ar9", "model.turbulence", "ar9"),
        (("model", "vibrations"), [], "model.vibrations", "leave the key out"),
        (("model", "vibrations", 0, "rms_mas"), -80, "model.vibrations[0].rms_mas", "greater than 0"),
        (("model", "vibrations", 0, "damping"), 1.0, "model.vibrations[0].damping", "less than 1"),
        (("model", "vibrations", 0, "damping"), 0, "model.vibrations[0].damping", "greater than 0"),
        (("model", "vibrations", 0, "rms_nm"), 5.0, "model.vibrations[0]", "exactly one of rms_nm"),
        (("model", "vibrations", 0, "direction_deg"), 5.0, "model.vibrations[0]", "exactly one of axis"),
        (("model", "vibrations", 0, "frequency_hz"), 500, "model.vibrations[0].frequency_hz", "Nyquist"),
        (("truth", "vibrations", 0, "frequency_hz"), 500, "truth.vibrations[0].frequency_hz", "Nyquist"),
        (("truth", "vibrations", 0, "damping"), 0.1, "truth.vibrations[0]", "damping goes with"),
        (("loop", "delay_frames"), 0.5, "loop.delay_frames", "greater than or equal to 1"),
        (("loop", "delay_frames"), "2", "loop.delay_frames", "valid number"),
        (("loop", "delay_frames"), True, "loop.delay_frames", "valid number"),
        (("loop", "frame_rate_hz"), float("nan"), "loop.frame_rate_hz", "finite number"),
        (("loop", "frame_rate_hz"), float("inf"), "loop.frame_rate_hz", "finite number"),
        (("sensor", "noise_nm"), 3.0, "sensor", "exactly one of noise_nm, noise_mas, pyramid"),
        (("sensor", "matrix"), [[1, 2], [3]], "", "sensor_matrix must be a rectangular array"),
        (("imaging", "other_modes_strehl"), 1.2, "imaging.other_modes_strehl", "less than or equal"),
        (("design", "gamma_ratio"), 0.9, "design.gamma_ratio", "greater than or equal to 1"),
        (("version",), 2, "version", "1"),
        (("version",), True, "version", "valid integer"),
        (("atmosphere", "seeing_arcsec"), 1e300, "", "far from any telescope"),
        (("atmosphere", "seeing_arcsec"), 1e-320, "", "far from any telescope"),
        (("sensor", "pyramid", "photons"), 1e300, "", "far from any telescope"),
        (("mirror", "influence_matrix"), [[0, 0], [0, 0]], "", "got only zeros"),
        (("model", "turbulence"), {"kind": "ar", "coefficients": [1.2], "driving_rms_nm": 1.0},
         "model.turbulence.coefficients", "must be stationary"),
    ],
)  # fmt: skip
def test_mistakes_are_refused_with_their_path(tmp_path, path, value, key, text):
    with pytest.raises(lbt.ConfigError) as caught:
        lbt.load_config(write(tmp_path, changed(path, value)))
    message = str(caught.value)
    assert text in message
    assert caught.value.path == key
    assert key in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "must hold a mapping"),
        ("- 1\n- 2\n", "must hold a mapping"),
        ("a: [1, 2\n", "not valid YAML"),
        ("version: 1\nversion: 1\n", "duplicate key"),
        ("a: !!python/object:os.system x\n", "not valid YAML"),
        ("\x00", "not valid YAML"),
        ("version: 2021-13-45\n", "not valid YAML"),
        ("version: !!float abc\n", "not valid YAML"),
        ("version: !!bool abc\n", "not valid YAML"),
        ("version: " + "9" * 5000 + "\n", "not valid YAML"),
        ("version: " + "[" * 3000 + "\n", "not valid YAML"),
    ],
)
def test_other_texts_are_refused(tmp_path, content, text):
    with pytest.raises(lbt.ConfigError, match=text) as caught:
        lbt.load_config(write(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(lbt.ConfigError, match="cannot read .*No such file"):
        lbt.load_config(tmp_path / "none.yaml")
    with pytest.raises(lbt.ConfigError, match="cannot read .*directory"):
        lbt.load_config(tmp_path)
    binary = tmp_path / "b.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(lbt.ConfigError, match="not a text file"):
        lbt.load_config(binary)


def test_every_kind_of_turbulence_and_noise(tmp_path):
    ar2 = lbt.load_config(write(tmp_path, changed(("model", "turbulence"), {"kind": "ar2"})))
    assert ar2.plant.turbulence[0].coefficients == pytest.approx([1.99747, -0.99755], abs=1e-4)
    given = {"kind": "ar", "coefficients": [0.9, 0.05], "driving_rms_nm": 3.0}
    ar = lbt.load_config(write(tmp_path, changed(("model", "turbulence"), given)))
    assert ar.plant.turbulence[0].coefficients.tolist() == [0.9, 0.05]
    mas = lbt.load_config(write(tmp_path, changed(("sensor",), {"noise_mas": 2.0})))
    assert mas.noise_nm == pytest.approx(2 * lbt.nm_per_mas(8.22))


def test_directions(tmp_path):
    line = {"direction_deg": 30.0, "frequency_hz": 20.0, "damping": 0.01, "rms_nm": 5.0}
    config = lbt.load_config(write(tmp_path, changed(("model", "vibrations"), [line])))
    assert config.plant.vibrations[0].direction == pytest.approx(
        (np.cos(np.pi / 6), np.sin(np.pi / 6))
    )
    both = lbt.load_config(LBT_YAML).plant.vibrations
    assert [v.direction for v in both] == [(1.0, 0.0), (0.0, 1.0)]


def test_sensor_gain_of_model_and_truth_are_relative(tmp_path):
    content = changed(("truth", "sensor_gain"), 0.5)
    content["model"]["sensor_gain"] = 0.5
    config = lbt.load_config(write(tmp_path, content))
    assert config.truth.sensor_gain == 1.0  # relative to what the design assumes
    assert np.array_equal(config.hardware.sensor, 0.5 * np.eye(2))


def test_a_plant_without_vibrations(tmp_path):
    config = lbt.load_config(write(tmp_path, changed(("model", "vibrations"), ...)))
    assert config.plant.vibrations == ()
