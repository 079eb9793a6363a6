"""Templates of telescopes: they load, they design, and every number says where it is from."""

import re

import pytest
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.config.templates import example_files, telescope_names, telescope_template

NAMES = ("elt", "gemini", "generic", "keck", "lbt", "vlt")


def test_there_is_a_template_of_each_telescope():
    assert telescope_names() == list(NAMES)
    with pytest.raises(lbt.errors.ProblemError, match="must be one of elt, gemini"):
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
