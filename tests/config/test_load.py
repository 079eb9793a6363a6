"""Configuration files: what is read, and what is refused with the path of its key."""

import re

import pytest
from support.configs import AR, GOOD, change_key, minimal_config, write_config
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.config.load import example_files, telescope_names, telescope_template
from lbt_synth.errors import ConfigError, ProblemError

NAMES = ("elt", "gemini", "generic", "keck", "lbt", "vlt")


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
        (("model", "turbulence", "kind"), "ar9", "model.turbulence.kind", "ar9"),
        (("model", "vibrations"), [], "model.vibrations", "leave the key out"),
        (
            ("model", "vibrations", 0, "rms_mas"),
            -80,
            "model.vibrations[0].rms_mas",
            "greater than or equal to 0.0001",
        ),
        (("model", "vibrations", 0, "damping"), 0.0, "model.vibrations[0].damping", "greater than"),
        (("model", "vibrations", 0, "damping"), 0, "model.vibrations[0].damping", "greater than"),
        (("model", "vibrations", 0, "rms_nm"), 5.0, "model.vibrations[0]", "exactly one of rms_nm"),
        (
            ("model", "vibrations", 0, "direction_deg"),
            5.0,
            "model.vibrations[0]",
            "at most one of axis",
        ),
        (
            ("model", "vibrations", 0, "frequency_hz"),
            500,
            "model.vibrations[0].frequency_hz",
            "Nyquist",
        ),
        (
            ("truth", "vibrations", 0, "frequency_hz"),
            500,
            "truth.vibrations[0].frequency_hz",
            "Nyquist",
        ),
        (("truth", "vibrations", 0, "damping"), 0.1, "truth.vibrations[0]", "damping goes with"),
        (("loop", "delay_frames"), 0.5, "loop.delay_frames", "greater than or equal to 1"),
        (("loop", "delay_frames"), "2", "loop.delay_frames", "valid number"),
        (("loop", "delay_frames"), True, "loop.delay_frames", "valid number"),
        (("loop", "frame_rate_hz"), float("nan"), "loop.frame_rate_hz", "finite number"),
        (("loop", "frame_rate_hz"), float("inf"), "loop.frame_rate_hz", "finite number"),
        (("sensor", "noise_nm"), 3.0, "sensor", "exactly one of noise_nm, noise_mas, pyramid"),
        (("sensor", "matrix"), [[1, 2], [3]], "", "sensor_matrix must be a rectangular array"),
        (
            ("imaging", "other_modes_strehl"),
            1.2,
            "imaging.other_modes_strehl",
            "less than or equal",
        ),
        (("design", "gamma_ratio"), 0.9, "design.gamma_ratio", "greater than or equal to 1"),
        (("version",), 2, "version", "1"),
        (("version",), True, "version", "valid integer"),
        (("mirror", "influence_matrix"), [[0, 0], [0, 0]], "", "got only zeros"),
        (
            ("model", "turbulence"),
            {"kind": "ar", "coefficients": [1.2], "driving_rms_nm": 1.0},
            "model.turbulence.coefficients",
            "must be stationary",
        ),
    ],
)
def test_mistakes_are_refused_with_their_path(tmp_path, path, value, key, text):
    with pytest.raises(ConfigError) as caught:
        lbt.load_config(write_config(tmp_path, change_key(path, value)))
    message = str(caught.value)
    assert text in message
    assert caught.value.path == key
    assert key in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "must hold sections, each with its keys; got nothing"),
        ("- 1\n- 2\n", "must hold sections, each with its keys; got a list"),
        ("a: [1, 2\n", "not valid YAML"),
        ("version: 1\nversion: 1\n", "duplicate key"),
        ("a: !!python/object:os.system x\n", "not valid YAML"),
        ("\x00", "not valid YAML"),
        ("version: 2021-13-45\n", "not valid YAML"),
        ("version: !!float abc\n", "not valid YAML"),
        ("version: " + "9" * 5000 + "\n", "not valid YAML"),
        ("version: " + "[" * 1000 + "\n", "not valid YAML"),
    ],
)
def test_other_texts_are_refused(tmp_path, content, text):
    with pytest.raises(ConfigError, match=text) as caught:
        lbt.load_config(write_config(tmp_path, content))
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path):
    with pytest.raises(ConfigError, match="cannot read .*No such file"):
        lbt.load_config(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="cannot read .*Is a directory"):
        lbt.load_config(tmp_path)
    binary = tmp_path / "b.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is not UTF-8 text: .* at byte"):
        lbt.load_config(binary)


@pytest.mark.parametrize(
    ("sections", "key", "text"),
    [
        (
            {"sensor": {"noise_nm": None, "noise_mas": 2.0}},
            "telescope",
            "telescope is missing: sensor.noise_mas is in mas",
        ),
        (
            {"sensor": {"noise_nm": None, "pyramid": GOOD["sensor"]["pyramid"]}},
            "telescope",
            "telescope is missing: the noise of sensor.pyramid",
        ),
        (
            {"model": {"turbulence": {"kind": "ar1"}}},
            "atmosphere",
            "atmosphere is missing: model.turbulence of kind ar1",
        ),
        (
            {"model": {"turbulence": [AR, {"kind": "ar2"}]}},
            "atmosphere",
            r"atmosphere is missing: model.turbulence\[1\] of kind ar2",
        ),
        (
            {
                "model": {
                    "vibrations": [
                        {"axis": "tip", "frequency_hz": 20.0, "damping": 0.01, "rms_mas": 30.0}
                    ]
                }
            },
            "telescope",
            r"telescope is missing: model.vibrations\[0\].rms_mas is in mas",
        ),
        (
            {
                "truth": {
                    "vibrations": [
                        {"kind": "sinusoid", "axis": "tip", "frequency_hz": 20.0, "rms_mas": 30.0}
                    ]
                }
            },
            "telescope",
            r"telescope is missing: truth.vibrations\[0\].rms_mas",
        ),
        (
            {"truth": {"turbulence": "frozen_flow"}},
            "atmosphere",
            "atmosphere is missing: truth.turbulence: frozen_flow",
        ),
        ({"atmosphere": GOOD["atmosphere"]}, "telescope", "telescope is missing: the turbulence"),
        # lists of another length, or of other things
        ({"sensor": {"noise_nm": [1.0]}}, "sensor.noise_nm", r"one per measurement \(2\); got 1"),
        ({"sensor": {"noise_nm": []}}, "sensor.noise_nm", "at least 1 item"),
        (
            {"sensor": {"noise_nm": [1.0, -1.0]}},
            "sensor.noise_nm[1]",
            "greater than or equal to 0.001",
        ),
        ({"sensor": {"noise_nm": "15"}}, "sensor.noise_nm", "valid number"),
        ({"model": {"turbulence": [AR]}}, "model.turbulence", r"one per axis \(2\); got 1"),
        ({"model": {"turbulence": []}}, "model.turbulence", "at least 1 item"),
        (
            {"model": {"turbulence": [AR, {**AR, "coefficients": [1.2]}]}},
            "model.turbulence[1].coefficients",
            "must be stationary",
        ),
        (
            {"model": {"turbulence": [AR, {**AR, "coefficient": 1}]}},
            "model.turbulence[1].coefficient",
            "did you mean coefficients",
        ),
        ({"model": {"sensor_gain": [1.0, 1.0, 1.0]}}, "model.sensor_gain", "got 3"),
        ({"truth": {"sensor_gain": [1.0]}}, "truth.sensor_gain", "got 1"),
        ({"truth": {"sensor_gain": [1.0, 0.9]}}, "truth.sensor_gain", "got the factors 1, 0.9"),
        ({"truth": {"vibrations": "same"}}, "truth.vibrations", "model"),
        (
            {
                "sensor": {"noise_nm": [1.0, 2.0, 3.0], "matrix": [[1, 0], [0, 1], [1, 1]]},
                "model": {"turbulence": {"kind": "ar2"}},
            },
            "model.turbulence",
            "3 for 2 axes",
        ),
        # one axis
        ({"loop": {"axes": 3}}, "loop.axes", "less than or equal to 2"),
        (
            {"loop": {"axes": 1}, "sensor": {"matrix": [[1, 0], [0, 1]]}},
            "sensor.matrix",
            "must have 1 columns to match loop.axes; got 2",
        ),
        (
            {
                "loop": {"axes": 1},
                "model": {
                    "vibrations": [
                        {"axis": "tilt", "frequency_hz": 20.0, "damping": 0.01, "rms_nm": 30.0}
                    ]
                },
            },
            "model.vibrations[0]",
            "one axis: leave axis and direction_deg out",
        ),
        (
            {
                "loop": {"axes": 1},
                "truth": {
                    "vibrations": [
                        {
                            "kind": "sinusoid",
                            "direction_deg": 3.0,
                            "frequency_hz": 20.0,
                            "rms_nm": 30.0,
                        }
                    ]
                },
            },
            "truth.vibrations[0]",
            "one axis",
        ),
        (
            {"model": {"vibrations": [{"frequency_hz": 20.0, "damping": 0.01, "rms_nm": 30.0}]}},
            "model.vibrations[0]",
            "expected exactly one of axis, direction_deg",
        ),
    ],
)
def test_what_is_missing_or_does_not_fit_is_said(tmp_path, sections, key, text):
    content = minimal_config(**sections)
    if content["sensor"]["noise_nm"] is None:
        del content["sensor"]["noise_nm"]
    with pytest.raises(ConfigError, match=text) as caught:
        lbt.load_config(write_config(tmp_path, content))
    assert caught.value.path == key
    assert "c.yaml" in str(caught.value)


def test_the_smallest_file_of_the_documentation(tmp_path):
    page = (ROOT / "docs" / "configuration.md").read_text()
    path = tmp_path / "page.yaml"
    path.write_text(page.split("```yaml\n")[1].split("```")[0])
    config = lbt.load_config(path)
    design = lbt.kalman(config.plant)
    loop = lbt.close_loop(config.hardware, design.controller)
    budget = lbt.residual_budget(loop, config.truth, frame_means=True)
    assert budget.rms_nm == pytest.approx(design.rms, rel=1e-8)


def test_what_is_no_configuration_by_far_is_refused(tmp_path):
    for text, why in (
        ("# " + "x" * 2**17, "it is larger than 128 kB"),
        ("version: 1\nsensor: &a [*a]\n", "sensor"),
        ("a: " + "[" * 2000, "not valid YAML"),
    ):
        path = tmp_path / "a.yaml"
        path.write_text(text)
        with pytest.raises(ConfigError, match=why) as caught:
            lbt.load_config(path)
        assert len(str(caught.value)) < 300


def test_there_is_a_template_of_each_telescope():
    assert telescope_names() == list(NAMES)
    with pytest.raises(ProblemError, match="must be one of elt, gemini"):
        telescope_template("hale")


@pytest.mark.parametrize("name", NAMES)
def test_a_template_makes_certified_filters(tmp_path, name):
    path = tmp_path / "t.yaml"
    path.write_text(telescope_template(name))
    config = lbt.load_config(path)
    design = lbt.kalman(config.plant)
    assert design.certificate.passed
    assert lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati").certificate.passed
    loop = lbt.close_loop(config.hardware, design.controller)
    left = lbt.residual_budget(loop, config.truth).rms_nm
    loop = lbt.close_loop(config.hardware, config.design("integrator").controller)
    assert left < 0.6 * lbt.residual_budget(loop, config.truth).rms_nm


@pytest.mark.parametrize("name", [name for name in NAMES if name != "lbt"])
def test_every_number_of_a_template_has_a_source_or_is_assumed(name):
    text = telescope_template(name)
    head, *sections = text.split("\n\n")
    sources = set(re.findall(r"^# (\[\d\]) ", head, re.MULTILINE))
    cited = set()
    for line in "\n\n".join(sections).splitlines():
        if re.search(r"^  +\w+: \d", line) and "seeing_wavelength_um: 0.5 " not in f"{line} ":
            assert re.search(r"# (\[\d\]|assumed)", line), line
        cited |= set(re.findall(r"# (\[\d\])", line))
    assert cited == sources
    assert all(
        "http" in mark or "eris_vib" in mark or "morfeo" in mark
        for mark in re.findall(r"^# \[\d\] (.+(?:\n#     .+)*)", head, re.MULTILINE)
    )


def test_the_examples_of_the_documentation_come_with_the_package():
    for name, text in example_files().items():
        assert text == (ROOT / "examples" / name).read_text()
    assert set(example_files()) == {path.name for path in (ROOT / "examples").glob("*.yaml")}
