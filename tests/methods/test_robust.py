"""The robust section of a configuration."""

from dataclasses import replace

import numpy as np
import pytest
from support.configs import AR, OTHER, minimal_config, write_config
from support.robust_config import SMALL, robust_writer

import lbt_synth as lbt
from lbt_synth.design.shaping import VibrationBand
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.methods.method import DesignInputs
from lbt_synth.methods.registry import method_named, reference_methods
from lbt_synth.methods.request import design_request
from lbt_synth.models import ARModel, TipTiltPlant


@pytest.fixture
def small(tmp_path):
    return robust_writer(tmp_path)


def test_sensor_gains_of_the_file_are_real_ones(small):
    plain = lbt.load_config(small()).design("robust")
    believed = {"a": ("    kind: ar2", "    kind: ar2\n  sensor_gain: 0.5")}
    section = SMALL + "    sensor_gain: [0.3, 0.8]\n    scenarios: [0.5]\n"
    design = lbt.load_config(small(section, **believed)).design("robust")
    assert plain.specifications[0].terms[0].sensor_gain == 1
    labels = [d.label for d in design.specifications[0].demands]
    assert "stability for sensor gains 0.6 to 1.6 and delay errors up to 0.1 frames" in labels
    noise = [d.specifications[0].terms[0].noise_nm for d in (plain, design)]
    assert noise[1] == pytest.approx(2 * noise[0])


def test_a_moving_gain_is_demanded_and_kept_in_the_file(small, tmp_path):
    section = SMALL + "    sensor_gain: [0.4, 1.4]\n    moving_gain: true\n"
    design = lbt.load_config(small(section)).design("robust")
    kept = lbt.load_gain(lbt.save_gain(tmp_path / "moving.fits", design))
    for each in (design, kept):
        kinds = [type(d).__name__ for d in each.specifications[0].demands]
        assert kinds == ["Bound", "LoopErrors"]
        assert each.specifications[0].demands[1].moving
    assert any("moving gain" in check.name for check in kept.recertify().checks)
    with pytest.raises(ProblemError, match="sensor_gain") as caught:
        lbt.load_config(small(SMALL + "    moving_gain: true\n")).design("robust")
    assert "moving_gain" in str(caught.value)


def test_clipped_commands_are_demanded_and_kept_in_the_file(small, tmp_path):
    free, design = (
        lbt.load_config(small(SMALL + section)).design("robust")
        for section in ("", "    stroke_ratio: 5\n")
    )
    kept = lbt.load_gain(lbt.save_gain(tmp_path / "clipped.fits", design))
    ratios = [lbt.loop.stroke_ratio(d.hardware, d) for d in (free, design, kept)]
    assert ratios[0] < 4 < 5 <= ratios[1] == ratios[2] < 5.1
    checks = [check.name for check in kept.recertify().checks]
    assert "mode 1: circle criterion of a moving gain, 0.2 to 1" in checks


def test_a_mirror_that_mixes_axes_has_no_demand_on_clipped_commands(tmp_path):
    band = {"low_hz": 18.0, "high_hz": 22.0, "rms_nm": 100.0}
    robust = {"bands": [band], "turbulence": "model", "functions": 8, "stroke_ratio": 5.0}
    content = minimal_config(design={"robust": robust})
    content["mirror"] = {"influence_matrix": [[1.0, 0.1], [0.0, 1.0]]}
    with pytest.raises(ConfigError, match="each command must move one axis alone") as caught:
        lbt.load_config(write_config(tmp_path, content)).design("robust")
    assert caught.value.path == "design.robust.stroke_ratio"
    content["design"]["robust"]["stroke_ratio"] = 1.0
    with pytest.raises(ConfigError, match="stroke_ratio: input should be greater than 1"):
        lbt.load_config(write_config(tmp_path, content))


def test_every_demand_of_the_file_reaches_the_specification(small):
    section = """    delay_error_frames: 0.2
    command_stroke_nm: 900.0
    command_step_nm: 200.0
    bounds:
      - {response: noise, at_most: 3.0}
      - {response: rejection, low_hz: 0.0, high_hz: 1.0, at_most: 0.2}
      - {response: complementary, at_most: 5.0, low_hz: 200.0, high_hz: 400.0}
"""
    design = lbt.load_config(small(SMALL + section)).design("robust")
    assert [demand.label for demand in design.specifications[0].demands] == [
        "modulus margin of at least 0.45",
        "stability for delay errors up to 0.2 frames",
        "amplification of noise of at most 3",
        "rejection of at most 0.2 in 0-1 Hz at sensor gain 1",
        "complementary sensitivity of at most 5 in 200-400 Hz",
        "command stroke of at most 900 nm rms",
        "command step of at most 200 nm rms",
    ]


def test_the_robust_design_of_an_identified_system(tmp_path):
    band = {"low_hz": 18.0, "high_hz": 22.0}
    robust = {"bands": [band | {"rms_nm": 100.0}], "functions": 8, "states": None}
    content = minimal_config(design={"robust": robust | {"modulus_margin": 0.3}})

    def design(**changes):
        content["design"]["robust"] |= changes
        return lbt.load_config(write_config(tmp_path, content)).design("robust")

    design()  # with the model's turbulence, as there is no atmosphere
    with pytest.raises(ConfigError, match="atmosphere is missing: design.robust.turbulence"):
        design(turbulence="frozen_flow")
    with pytest.raises(
        ConfigError, match=r"telescope is missing: design.robust.bands\[0\].rms_mas"
    ):
        design(turbulence="model", bands=[band | {"rms_mas": 9.0}])
    content["model"]["turbulence"] = [AR, OTHER]
    with pytest.raises(ConfigError, match="hold under one turbulence for all axes"):
        design(bands=robust["bands"], command_step_nm=500.0)
    content["loop"]["axes"] = 1
    content["model"] = {"turbulence": AR}
    with pytest.raises(ProblemError, match=r"design\.robust\.bands\[0\]\.axis: this loop has 1"):
        design(bands=[band | {"rms_nm": 9.0, "axis": "tip"}])


def a_plant_with_lines(*lines, more=()):
    air = ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    shakes = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=rms, direction=(1,)) for f, rms in lines
    ]
    known = {"turbulence": air, "vibrations": [*shakes, *more], "noise_nm": 15.5}
    return lbt.tip_tilt_plant(frame_rate_hz=800, modes=1, **known)


def test_a_plant_alone_has_a_band_around_each_line():
    plant = a_plant_with_lines((20, 80.0), (50, 30.0), (50.5, 40.0))
    section = method_named("robust").plant_section(plant)
    edges = [(band.low_hz, band.high_hz, band.rms_nm) for band in section.bands]
    assert np.array(edges) == pytest.approx(np.array([(19.6, 20.4, 80.0), (49.0, 51.51, 50.0)]))
    design = design_request("robust", {}).build(DesignInputs(plant=plant))
    assert design.certificate.passed
    lines = lbt.close_loop(plant.hardware, design.controller).path("phase", "residual")
    assert abs(lines.frequency_response([20.0])[0, 0, 0]) < 0.2
    many = a_plant_with_lines(*((10.0 * k, 10.0 + k) for k in range(1, 10)))
    section = method_named("robust").plant_section(many)  # of the strongest
    assert [round(band.rms_nm) for band in section.bands] == [14, 15, 16, 17, 18, 19]
    with pytest.raises(ProblemError, match="the plant has none"):
        design_request("robust", {}).build(DesignInputs(plant=a_plant_with_lines()))


def a_plant_with_a_wide_resonance() -> TipTiltPlant:
    wide = lbt.Vibration(frequency_hz=30, damping=0.9, rms_nm=25.0, direction=(1.0,))
    return a_plant_with_lines((20, 80.0), (50, 30.0), more=[wide])


def test_a_wide_resonance_has_no_band_and_is_a_disturbance():
    """Its band swallowed those of the lines: the design left 1.6 times the residual."""
    plant = a_plant_with_a_wide_resonance()
    inputs = DesignInputs(plant=plant)
    bands = method_named("robust").plant_section(plant).bands
    assert [(band.rms_nm, band.damping) for band in bands] == [(80.0, 0.01), (30.0, 0.01)]
    design = design_request("robust", {}).build(inputs)
    (spec,) = design.specifications
    _, wide, *lines = spec.terms
    assert wide.label == "disturbance at sensor gain 1"
    assert wide.turbulence.rms_nm == pytest.approx(25.0)
    assert len(lines) == 2
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=plant.vibrations, noise_nm=15.5)
    loops = [lbt.close_loop(plant.hardware, d.controller) for d in (design, lbt.kalman(plant))]
    found, best = (lbt.residual_budget(loop, truth).rms_nm for loop in loops)
    assert best < found < 1.1 * best


def test_a_band_that_covers_a_wide_resonance_takes_its_place():
    plant = a_plant_with_a_wide_resonance()
    wide = {"low_hz": 25.0, "high_hz": 35.0, "rms_nm": 25.0}
    for damping, terms in ((0.6, 2), (0.1, 3)):
        band = VibrationBand(**wide, damping=damping)
        design = lbt.robust(plant, bands=[band], functions=8, states=None, modulus_margin=0.2)
        assert len(design.specifications[0].terms) == terms


def test_bands_have_an_axis_and_the_damping_of_the_model(tmp_path):
    edges = [(16.0, 20.0, {"axis": "tip"}), (30.0, 33.0, {"axis": "tilt", "damping": 0.03})]
    edges += [(60.0, 70.0, {})]
    wanted = [{"low_hz": low, "high_hz": high, "rms_nm": 50.0} | more for low, high, more in edges]
    line = {"axis": "both", "frequency_hz": 18.0, "damping": 0.01, "rms_nm": 100.0}
    content = minimal_config(
        model={"vibrations": [line, line | {"axis": "tip", "frequency_hz": 31.0}]},
        design={"robust": {"bands": wanted, "functions": 8, "states": None}},
    )
    design = lbt.load_config(write_config(tmp_path, content)).design("robust")
    bands = [
        [(term.low_hz, term.damping) for term in spec.terms[1:]] for spec in design.specifications
    ]
    assert bands == [[(16.0, 0.01), (60.0, 0.0)], [(30.0, 0.03), (60.0, 0.0)]]


def worst_in_bands(config, design):
    """Return the worst variance with the resonances of the truth anywhere in their bands [nm^2]."""
    loop = lbt.close_loop(config.hardware, design.controller)
    total = lbt.residual_budget(loop, replace(config.truth, vibrations=())).rms_nm ** 2
    bands = config.settings.design.robust.bands
    for line, band in zip(config.truth.vibrations, bands, strict=True):
        lines = (
            replace(line, frequency_hz=float(f)) for f in np.linspace(band.low_hz, band.high_hz, 9)
        )
        alone = [lbt.Truth(turbulence=None, vibrations=(each,)) for each in lines]
        total += max(lbt.residual_budget(loop, truth).rms_nm ** 2 for truth in alone)
    return total


def test_robust_stays_beside_the_filters_within_its_bands(tmp_path):
    """A loop of 8 m with two resonances, of which the bands do not say the damping."""
    shakes = {"tip": (18.0, 116.0, 2.0), "tilt": (48.0, 78.0, 3.0)}
    lines = [
        {"axis": axis, "frequency_hz": f, "damping": 0.01, "rms_nm": rms}
        for axis, (f, rms, _) in shakes.items()
    ]
    bands = [
        {"low_hz": f - half, "high_hz": f + half, "rms_nm": rms, "axis": axis}
        for axis, (f, rms, half) in shakes.items()
    ]
    content = minimal_config(
        sensor={"noise_nm": 20.0},
        loop={"frame_rate_hz": 1000.0, "delay_frames": 2.0},
        model={"vibrations": lines},
        truth={"turbulence": "model", "vibrations": [{"kind": "resonance", **x} for x in lines]},
        design={"robust": {"bands": bands, "functions": 30, "states": None}},
    )
    config = lbt.load_config(write_config(tmp_path, content))
    filters = [
        worst_in_bands(config, config.design(method.name, **method.reference_options))
        for method in reference_methods()
    ]
    assert worst_in_bands(config, config.design("robust")) < 1.01 * min(filters)
