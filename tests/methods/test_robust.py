"""The robust section of a configuration."""

import pytest
from support.configs import AR, OTHER, minimal_config, write_config
from support.robust_config import SMALL, robust_writer

import lbt_synth as lbt


@pytest.fixture
def small(tmp_path):
    return robust_writer(tmp_path)


def test_sensor_gains_of_the_file_are_real_ones(small):
    plain = lbt.load_config(small()).design("robust")
    believed = {"a": ("    kind: ar2", "    kind: ar2\n  sensor_gain: 0.5")}
    section = SMALL + "    sensor_gain: [0.3, 0.8]\n    scenarios: [0.5]\n"
    design = lbt.load_config(small(section, **believed)).design("robust")
    assert plain.specifications[0].objective.terms[0].sensor_gain == 1
    labels = [d.label for d in design.specifications[0].demands]
    assert "stability for sensor gains 0.6 to 1.6" in labels
    noise = [d.specifications[0].objective.terms[0].noise_nm for d in (plain, design)]
    assert noise[1] == pytest.approx(2 * noise[0])


def test_every_demand_of_the_file_reaches_the_specification(small):
    section = (
        SMALL
        + """    noise_peak: 3.0
    delay_error_frames: 0.2
    command_stroke_nm: 900.0
    command_step_nm: 200.0
    attenuation:
      - {low_hz: 0.0, high_hz: 1.0, at_most: 0.2}
    mirror_uncertainty:
      - {relative: 0.2, low_hz: 200.0, high_hz: 400.0}
"""
    )
    design = lbt.load_config(small(section)).design("robust")
    kinds = [type(d).__name__ for d in design.specifications[0].demands]
    assert kinds == [
        "ModulusMargin",
        "NoisePeak",
        "DelayError",
        "Attenuation",
        "MirrorUncertainty",
        "CommandRms",
        "CommandRms",
    ]


def test_the_robust_design_of_an_identified_system(tmp_path):
    band = {"low_hz": 18.0, "high_hz": 22.0, "rms_nm": 100.0}
    robust = {"bands": [band], "functions": 8, "states": None, "modulus_margin": 0.3}
    content = minimal_config(design={"robust": robust})
    config = lbt.load_config(write_config(tmp_path, content))
    config.design("robust")  # with the model's turbulence, as there is no atmosphere
    for change, text in (
        ({"turbulence": "frozen_flow"}, "atmosphere is missing: design.robust.turbulence"),
        (
            {"bands": [{"low_hz": 18.0, "high_hz": 22.0, "rms_mas": 9.0}]},
            r"telescope is missing: design.robust.bands\[0\].rms_mas",
        ),
    ):
        content["design"] = {"robust": {**robust, **change}}
        with pytest.raises(lbt.errors.ConfigError, match=text):
            lbt.load_config(write_config(tmp_path, content)).design("robust")
    content["design"] = {"robust": {**robust, "command_step_nm": 500.0}}
    content["model"]["turbulence"] = [AR, OTHER]
    with pytest.raises(lbt.errors.ConfigError, match="hold under one turbulence for all axes"):
        lbt.load_config(write_config(tmp_path, content)).design("robust")
