"""The robust section of a configuration."""

import numpy as np
import pytest
from support.configs import AR, OTHER, minimal_config, write_config
from support.robust_config import SMALL, robust_writer

import lbt_synth as lbt
from lbt_synth.errors import ProblemError
from lbt_synth.methods.registry import plant_methods
from lbt_synth.methods.request import PlantInputs, design_request


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


def a_plant_with_lines(*lines):
    slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    shakes = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=rms, direction=(1,)) for f, rms in lines
    ]
    return lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=slow, vibrations=shakes or None, noise_nm=15.5, modes=1
    )


def test_a_plant_alone_has_a_band_around_each_line():
    plant = a_plant_with_lines((20, 80.0), (50, 30.0), (50.5, 40.0))
    section = PlantInputs(plant=plant).method_section("robust")
    edges = [(band.low_hz, band.high_hz, band.rms_nm) for band in section.bands]
    assert np.array(edges) == pytest.approx(np.array([(19.6, 20.4, 80.0), (49.0, 51.51, 50.0)]))
    assert "robust" in plant_methods()
    design = design_request("robust", {}).build(PlantInputs(plant=plant))
    assert design.certificate.passed
    lines = lbt.close_loop(plant.hardware, design.controller).rejection()
    assert abs(lines.frequency_response([20.0])[0, 0, 0]) < 0.2


def test_the_strongest_lines_of_a_plant_have_bands():
    lines = [(10.0 * k, 10.0 + k) for k in range(1, 10)]
    section = PlantInputs(plant=a_plant_with_lines(*lines)).method_section("robust")
    assert [round(band.rms_nm) for band in section.bands] == [14, 15, 16, 17, 18, 19]


def test_a_plant_without_lines_has_no_robust_design():
    with pytest.raises(ProblemError, match="the plant has none"):
        design_request("robust", {}).build(PlantInputs(plant=a_plant_with_lines()))
