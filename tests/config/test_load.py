"""Configuration files: what is read, and what is refused with the path of its key."""

import re

import pytest
from support.configs import AR, GOOD, change_key, minimal_config, write_config
from support.plants import ROOT
from support.refusals import refused

import lbt_synth as lbt
from lbt_synth.config.load import example_files, telescope_names, telescope_template
from lbt_synth.config.samples import parse_path
from lbt_synth.errors import ConfigError, ProblemError

NAMES = ("elt", "gemini", "generic", "keck", "lbt", "vlt")


def test_the_example_is_the_papers_table_i(config):
    s = config.settings
    telescope, loop, pyramid = s.telescope, s.loop, s.sensor.pyramid
    air = s.atmosphere
    assert (telescope.diameter_m, telescope.obstruction, s.mirror.modes) == (8.22, 0.11, 672)
    assert (air.seeing_arcsec, air.outer_scale_m, air.wind_speed_m_s) == (0.8, 22, 20)
    assert (pyramid.wavelength_um, pyramid.modulation_lambda_over_d) == (0.75, 4)
    assert (pyramid.photons, pyramid.read_noise_electrons) == (50, 8)
    assert (pyramid.subapertures_across, loop.frame_rate_hz, loop.delay_frames) == (30, 800, 2)
    assert config.noise_nm == pytest.approx(15.6, abs=0.1)
    assert config.plant.vibrations[0].rms_nm == pytest.approx(797, abs=0.1)
    assert config.plant.turbulence[0].coefficients[0] == pytest.approx(0.98860, abs=5e-6)


UNSTABLE = {"kind": "ar", "coefficients": [1.2], "driving_rms_nm": 1.0}


def line_in(section, **keys):
    kind = {"damping": 0.01} if section == "model" else {"kind": "sinusoid"}
    return {section: {"vibrations": [{"frequency_hz": 20.0, **kind, **keys}]}}


ONE_KEY = [  # what is set in the example, or taken away, and what is said of it
    ("telescope.diameter_mm", 8220, "did you mean diameter_m"),
    ("loop.frame_rate_khz", 0.8, "did you mean frame_rate_hz"),
    ("weather", {}, "known are"),
    ("loop.frame_rate_hz", ..., "is missing"),
    ("atmosphere", ..., "is missing"),
    ("model.turbulence.kind", "ar9", "ar9"),
    ("model.vibrations", [], "leave the key out"),
    ("model.vibrations[0].frequency_hz", 500, "Nyquist"),
    ("truth.vibrations[0].frequency_hz", 500, "Nyquist"),
    ("loop.delay_frames", 0.5, "greater than or equal to 1"),
    ("loop.delay_frames", "2", "valid number"),
    ("loop.delay_frames", True, "valid number"),
    ("loop.frame_rate_hz", float("nan"), "finite number"),
    ("version", 2, "1"),
    ("version", True, "valid integer"),
]
OTHER_KEY = [  # what is said of another key, or of none
    ("model.vibrations[0].rms_nm", 5.0, "model.vibrations[0]", "exactly one of rms_nm"),
    ("model.vibrations[0].direction_deg", 5.0, "model.vibrations[0]", "at most one of axis"),
    ("truth.vibrations[0].damping", 0.1, "truth.vibrations[0]", "damping goes with"),
    ("sensor.matrix", [[]], "sensor.matrix[0]", "at least 1 item"),
    ("sensor.noise_nm", 3.0, "sensor", "got noise_nm and pyramid"),
    ("sensor.matrix", [[1, 2], [3]], "sensor.matrix", "sensor.matrix must be a rect"),
    ("mirror.influence_matrix", [[0, 0], [0, 0]], "mirror.influence_matrix", "got only zeros"),
    ("model.turbulence", UNSTABLE, "model.turbulence.coefficients", "must be stationary"),
]
TELESCOPE, AIR = "telescope is missing: .*", "atmosphere is missing: .*"
SECOND, ONE = "model.turbulence[1].coefficient", {"loop": {"axes": 1}}
LEAVE_OUT = "one axis: leave axis and direction_deg out"
AR1, AR2, PYRAMID = {"kind": "ar1"}, {"kind": "ar2"}, {"pyramid": GOOD["sensor"]["pyramid"]}
THREE = {"noise_nm": [1.0, 2.0, 3.0], "matrix": [[1, 0], [0, 1], [1, 1]]}
SECTIONS = [  # of the smallest configuration
    ({"sensor": {"noise_mas": 2.0}}, "telescope", f"{TELESCOPE}sensor.noise_mas is in mas"),
    ({"sensor": PYRAMID}, "telescope", f"{TELESCOPE}the noise of sensor.pyramid"),
    ({"model": {"turbulence": AR1}}, "atmosphere", f"{AIR}model.turbulence of kind ar1"),
    ({"model": {"turbulence": [AR, AR2]}}, "atmosphere", rf"{AIR}.*\[1\] of kind ar2"),
    (line_in("model", axis="tip", rms_mas=30.0), "telescope", rf"{TELESCOPE}model.*\[0\].rms_mas"),
    (line_in("truth", axis="tip", rms_mas=30.0), "telescope", rf"{TELESCOPE}truth.*\[0\].rms_mas"),
    ({"truth": {"turbulence": "frozen_flow"}}, "atmosphere", f"{AIR}truth.turbulence: frozen_flow"),
    ({"atmosphere": GOOD["atmosphere"]}, "telescope", f"{TELESCOPE}the turbulence"),
    # lists of another length, or of other things
    ({"sensor": {"noise_nm": None}}, "sensor", "one of noise_nm, noise_mas, pyramid; got none"),
    ({"sensor": {"noise_nm": [1.0]}}, "sensor.noise_nm", r"one per measurement \(2\); got 1"),
    ({"sensor": {"noise_nm": [1.0, -1.0]}}, "sensor.noise_nm[1]", "greater than or equal to 0.001"),
    ({"model": {"turbulence": [AR]}}, "model.turbulence", r"one per axis \(2\); got 1"),
    ({"model": {"turbulence": [AR, UNSTABLE]}}, f"{SECOND}s", "must be stationary"),
    ({"model": {"turbulence": [AR, {**AR, "coefficient": 1}]}}, SECOND, "mean coefficients"),
    ({"model": {"sensor_gain": [1.0, 1.0, 1.0]}}, "model.sensor_gain", "got 3"),
    ({"truth": {"sensor_gain": [1.0, 0.9]}}, "truth.sensor_gain", "valid number"),
    ({"sensor": THREE, "model": {"turbulence": AR2}}, "model.turbulence", "3 for 2 axes"),
    # one axis
    ({"sensor": {"matrix": [[1, 0], [0, 1]]}, **ONE}, "sensor.matrix", "1 columns .*; got 2"),
    ({**line_in("model", axis="tilt", rms_nm=30.0), **ONE}, "model.vibrations[0]", LEAVE_OUT),
    ({**line_in("truth", direction_deg=3.0, rms_nm=9.0), **ONE}, "truth.vibrations[0]", LEAVE_OUT),
    (line_in("model", rms_nm=30.0), "model.vibrations[0]", "of axis, direction_deg; got none"),
]


def smallest(sections):
    content = minimal_config(**sections)
    if {"noise_mas", "pyramid"} & content["sensor"].keys():
        del content["sensor"]["noise_nm"]
    return content


@pytest.mark.parametrize(
    ("content", "key", "text"),
    [
        *((change_key(parse_path(path), value), path, text) for path, value, text in ONE_KEY),
        *((change_key(parse_path(path), value), *said) for path, value, *said in OTHER_KEY),
        *((smallest(sections), *said) for sections, *said in SECTIONS),
    ],
)
def test_mistakes_are_refused_with_their_path(tmp_path, content, key, text):
    file = write_config(tmp_path, content)
    error = refused(lambda: lbt.load_config(file), ConfigError, text)
    assert (error.path, "\n" in str(error)) == (key, False)
    assert all(word in str(error) for word in (key, "c.yaml"))


def test_other_texts_are_refused(tmp_path):
    empty, odd = "must hold sections, each with its keys; got ", "not valid YAML"
    file = tmp_path / "c.yaml"
    for content, text in (
        (b"", empty + "nothing"),
        (b"- 1\n- 2\n", empty + "a list"),
        (b"a: [1, 2\n", odd),
        (b"version: 1\nversion: 1\n", "duplicate key"),
        (b"a: !!python/object:os.system x\n", odd),
        (b"\x00", odd),
        (b"a: " + b"[" * 1000, odd),
        (b"# " + b"x" * 2**17, "it is larger than 128 kB"),
        (b"version: 1\nsensor: &a [*a]\n", "sensor"),
        (b"\xff\xfe\x00", "is not UTF-8 text: .* at byte"),
    ):
        file.write_bytes(content)
        message = str(refused(lambda: lbt.load_config(file), ConfigError, text))
        assert ("\n" in message, len(message) < 300) == (False, True)
    file.unlink()
    refused(lambda: lbt.load_config(file), ConfigError, "cannot read .*No such file")
    refused(lambda: lbt.load_config(None), ProblemError, "path of a file; got NoneType")


def test_templates_and_examples_come_with_the_package(tmp_path):
    assert telescope_names() == list(NAMES)
    refused(lambda: telescope_template("hale"), ProblemError, "must be one of elt, gemini")
    examples = {path.name: path.read_text() for path in (ROOT / "examples").glob("*.yaml")}
    assert dict(example_files()) == examples
    page = (ROOT / "docs" / "configuration.md").read_text()
    smallest = write_config(tmp_path, page.split("```yaml\n")[1].split("```")[0])
    assert lbt.load_config(smallest).design("kalman").certificate.passed


@pytest.mark.parametrize("name", NAMES)
def test_a_template_makes_certified_filters(tmp_path, name):
    config = lbt.load_config(write_config(tmp_path, telescope_template(name)))
    designs = config.design("kalman"), config.design("integrator")
    loops = [lbt.close_loop(config.hardware, design.controller) for design in designs]
    residual, baseline = (lbt.residual_budget(loop, config.truth).rms_nm for loop in loops)
    assert residual < 0.6 * baseline
    robust = lbt.hinf(config.plant, gamma_ratio=1.2, route="riccati")
    assert all(design.certificate.passed for design in (*designs, robust))


@pytest.mark.parametrize("name", [name for name in NAMES if name != "lbt"])
def test_every_number_of_a_template_has_a_source_or_is_assumed(name):
    head, *sections = telescope_template(name).split("\n\n")
    sources = set(re.findall(r"^# (\[\d\]) ", head, re.MULTILINE))
    cited = set()
    for line in "\n\n".join(sections).splitlines():
        if re.search(r"^  +\w+: \d", line) and "seeing_wavelength_um: 0.5 " not in f"{line} ":
            assert re.search(r"# (\[\d\]|assumed)", line), line
        cited |= set(re.findall(r"# (\[\d\])", line))
    assert cited == sources
    for mark in re.findall(r"^# \[\d\] (.+(?:\n#     .+)*)", head, re.MULTILINE):
        assert "http" in mark or "eris_vib" in mark or "morfeo" in mark
