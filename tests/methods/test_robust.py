"""The robust section of a configuration."""

from functools import partial

import numpy as np
import pytest
from support.configs import AR, OTHER, minimal_config, write_config
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.design.shaping import VibrationBand
from lbt_synth.errors import ConfigError, ProblemError
from lbt_synth.methods.method import DesignInputs
from lbt_synth.methods.registry import method_named
from lbt_synth.methods.request import design_request
from lbt_synth.models import ARModel, TipTiltPlant

BAND = {"low_hz": 19.0, "high_hz": 21.0, "rms_nm": 400.0}


@pytest.fixture
def design(tmp_path):
    """Function that designs for the smallest configuration, some keys of it changed."""

    def make(section=None, **sections):
        robust = {"bands": [BAND], "functions": 16, "states": None} | (section or {})
        content = minimal_config(**sections, design={"robust": robust})
        return lbt.load_config(write_config(tmp_path, content)).design("robust")

    return make


def test_gains_that_move_are_demanded_and_kept_in_the_file(design, tmp_path):
    moving, clipped = {"sensor_gain": [0.4, 1.4], "moving_gain": True}, {"stroke_ratio": 5.0}
    for section, interval in ((moving, "0.4 to 1.4"), (clipped, "0.2 to 1")):
        made = design(section)
        kept = lbt.load_gain(lbt.save_gain(tmp_path / "moving.fits", made))
        for robust in (made, kept):
            demand = robust.specifications[0].demands[-1]
            assert (type(demand).__name__, demand.moving) == ("LoopErrors", True)
        checks = [check.name for check in kept.recertify().checks]
        assert f"mode 1: circle criterion of a moving gain, {interval}" in checks
    ratios = [lbt.loop.stroke_ratio(d.hardware, d) for d in (design(), made, kept)]
    assert ratios[0] < 4 < 5 <= ratios[1] == ratios[2] < 5.1


def test_every_demand_of_the_file_reaches_the_specification(design):
    section = {
        "sensor_gain": [0.3, 0.8],  # real ones, where the model's is 0.5
        "scenarios": [0.5],
        "delay_error_frames": 0.2,
        "command_stroke_nm": 900.0,
        "command_step_nm": 200.0,
        "bounds": [
            {"response": "noise", "at_most": 3.0},
            {"response": "rejection", "high_hz": 1.0, "at_most": 0.2, "sensor_gain": 0.5},
            {"response": "complementary", "at_most": 5.0, "low_hz": 200.0, "high_hz": 400.0},
        ],
    }
    made = (design(), design(section, model={"sensor_gain": 0.5}))
    plain, full = (robust.specifications[0] for robust in made)
    assert plain.demands[-1].label == "stability for delay errors up to 0.1 frames"
    assert [demand.label for demand in full.demands] == [
        "modulus margin of at least 0.45",
        "stability for sensor gains 0.6 to 1.6 and delay errors up to 0.2 frames",
        "amplification of noise of at most 3",
        "rejection of at most 0.2 in 0-1 Hz at sensor gain 1",
        "complementary sensitivity of at most 5 in 200-400 Hz",
        "command stroke of at most 900 nm rms",
        "command step of at most 200 nm rms",
    ]
    assert plain.terms[0].sensor_gain == full.terms[0].sensor_gain == 1
    assert full.terms[0].noise_nm == pytest.approx(2 * plain.terms[0].noise_nm)


def test_refusals(design):
    mixing = {"mirror": {"influence_matrix": [[1.0, 0.1], [0.0, 1.0]]}}
    line = {"frequency_hz": 20.0, "damping": 0.01, "rms_nm": 300.0}
    one_axis = {"loop": {"axes": 1}, "model": {"vibrations": [line]}}
    uneven = {"model": {"turbulence": [AR, OTHER]}}
    angle = {"low_hz": 18.0, "high_hz": 22.0, "rms_mas": 9.0}
    rows = [
        ({"moving_gain": True}, {}, "(?s)(?=.*moving_gain).*sensor_gain"),
        ({"stroke_ratio": 1.0}, {}, "stroke_ratio: input should be greater than 1"),
        ({"turbulence": "frozen_flow"}, {}, "atmosphere is missing: design.robust.turbulence"),
        ({"bands": [angle]}, {}, r"telescope is missing: design.robust.bands\[0\].rms_mas"),
        ({"command_step_nm": 500.0}, uneven, "hold under one turbulence for all axes"),
        ({"bands": [BAND | {"axis": "tip"}]}, one_axis, r"bands\[0\]\.axis: this loop has 1"),
    ]
    require_refusals((partial(design, s, **more), ProblemError, words) for s, more, words in rows)
    call, words = partial(design, {"stroke_ratio": 5.0}, **mixing), "must move one axis alone"
    assert refused(call, ConfigError, words).path == "design.robust.stroke_ratio"
    still = partial(design_request("robust", {}).build, DesignInputs(plant=plant_of_lines()))
    refused(still, ProblemError, "the plant has none")


def plant_of_lines(*lines, more=()) -> TipTiltPlant:
    air = ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    shakes = [
        lbt.Vibration(frequency_hz=f, damping=0.01, rms_nm=rms, direction=(1,)) for f, rms in lines
    ]
    facts = {"turbulence": air, "vibrations": [*shakes, *more], "noise_nm": 15.5}
    return lbt.tip_tilt_plant(frame_rate_hz=800, modes=1, **facts)


def test_a_plant_alone_has_a_band_around_each_line():
    plant = plant_of_lines((20, 80.0), (50, 30.0), (50.5, 40.0))
    section = method_named("robust").plant_section(plant)
    edges = [(band.low_hz, band.high_hz, band.rms_nm) for band in section.bands]
    assert np.array(edges) == pytest.approx(np.array([(19.6, 20.4, 80.0), (49.0, 51.51, 50.0)]))
    robust = design_request("robust", {}).build(DesignInputs(plant=plant))
    assert robust.certificate.passed
    rejection = lbt.close_loop(plant.hardware, robust.controller).sensitivity([20.0])
    assert abs(rejection.item()) < 0.2
    many = plant_of_lines(*((10.0 * k, 10.0 + k) for k in range(1, 10)))
    section = method_named("robust").plant_section(many)  # of the strongest
    assert [round(band.rms_nm) for band in section.bands] == [14, 15, 16, 17, 18, 19]


@pytest.fixture(scope="module")
def wide_plant():
    """A plant with two lines and a resonance that is wide."""
    wide = lbt.Vibration(frequency_hz=30, damping=0.9, rms_nm=25.0, direction=(1.0,))
    return plant_of_lines((20, 80.0), (50, 30.0), more=[wide])


def test_a_wide_resonance_has_no_band_and_is_a_disturbance(wide_plant):
    """Its band swallowed those of the lines: the design left 1.6 times the residual."""
    plant = wide_plant
    bands = method_named("robust").plant_section(plant).bands
    assert [(band.rms_nm, band.damping) for band in bands] == [(80.0, 0.01), (30.0, 0.01)]
    robust = design_request("robust", {}).build(DesignInputs(plant=plant))
    _, wide, *lines = robust.specifications[0].terms
    assert wide.label == "disturbance at sensor gain 1"
    assert wide.turbulence.rms_nm == pytest.approx(25.0)
    assert len(lines) == 2
    truth = lbt.Truth(turbulence=plant.turbulence[0], vibrations=plant.vibrations, noise_nm=15.5)
    loops = [lbt.close_loop(plant.hardware, d.controller) for d in (robust, lbt.kalman(plant))]
    residual_nm, least_nm = (lbt.residual_budget(loop, truth).rms_nm for loop in loops)
    assert least_nm < residual_nm < 1.1 * least_nm


def test_a_band_that_covers_a_wide_resonance_takes_its_place(wide_plant):
    wide = {"low_hz": 25.0, "high_hz": 35.0, "rms_nm": 25.0}
    options = {"functions": 8, "states": None, "modulus_margin": 0.2}
    for damping, terms in ((0.6, 2), (0.1, 3)):
        robust = lbt.robust(wide_plant, bands=[VibrationBand(**wide, damping=damping)], **options)
        assert len(robust.specifications[0].terms) == terms


def test_bands_have_an_axis_and_the_damping_of_the_model(design):
    edges = [(16.0, 20.0, {"axis": "tip"}), (30.0, 33.0, {"axis": "tilt", "damping": 0.03})]
    edges += [(60.0, 70.0, {})]
    bands = [{"low_hz": low, "high_hz": high, "rms_nm": 50.0} | more for low, high, more in edges]
    line = {"axis": "both", "frequency_hz": 18.0, "damping": 0.01, "rms_nm": 100.0}
    lines = [line, line | {"axis": "tip", "frequency_hz": 31.0}]
    robust = design({"bands": bands}, model={"vibrations": lines})
    assert [[(t.low_hz, t.damping) for t in spec.terms[1:]] for spec in robust.specifications] == [
        [(16.0, 0.01), (60.0, 0.0)],
        [(30.0, 0.03), (60.0, 0.0)],
    ]
