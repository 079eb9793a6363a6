"""From a wish to what the page shows."""

import numpy as np
import pytest
from support.configs import AR, change_key, write_config
from support.explore import five_lines
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.linear import largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.report.explore.exploration import (
    describe_moves,
    explore,
    explored_table,
    fulfil,
    judge,
    list_knobs,
    moved_knobs,
    new_view,
    shift_range_hz,
    show_design,
)
from lbt_synth.report.figures.records import exact_spectrum
from lbt_synth.storage.display_unit import own_display_unit, show_in


@pytest.fixture(scope="module")
def exploration():
    config = lbt.load_config("examples/lbt.yaml")
    return explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})


def test_a_view_begins_with_its_own_design(exploration):
    view = new_view(exploration)
    assert view.name == "Kalman"
    assert [row[0] for row in explored_table(view.shown).rows] == ["Kalman", "old"]


def test_names_are_unique(exploration):
    again = explore(exploration.config, {"Kalman": lbt.kalman(exploration.config.plant)})
    assert list(new_view(again).shown) == ["Kalman by the sliders", "Kalman"]


def test_a_design_for_another_loop_is_refused(exploration):
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3)
    with pytest.raises(
        lbt.errors.ProblemError, match="slow must run at the configuration's 800 Hz"
    ):
        explore(exploration.config, {"slow": other})


def test_the_verdict(exploration):
    view = new_view(exploration)
    budget = lbt.residual_budget(
        lbt.close_loop(view.config.hardware, view.design.controller), view.config.truth
    )
    text = judge(view)
    assert text.startswith(f"Kalman leaves {budget.rms_nm:.1f} nm rms, Strehl ratio 82.7 %")
    assert "above the least of any linear controller" in text
    assert "Margins: modulus 0." in text
    low, high = lbt.loop.stable_sensor_gains(view.config.hardware, view.design.controller)
    certified = f"certified (10 checks), and stable for sensor gains of {low:.3g} to {high:.3g}"
    assert text.endswith(f"It is {certified}.")
    unstable = new_view(exploration, "kalman", {"gain": 2.4})
    assert judge(unstable) == f"Kalman is {certified}; at 2.4 this loop is UNSTABLE."


def test_a_thin_delay_margin_is_a_warning(exploration):
    high = lbt.loop_margins(
        lbt.close_loop(exploration.config.hardware, new_view(exploration).design.controller)
    ).gain_high
    assert "WARNING: " in judge(new_view(exploration, "kalman", {"gain": 0.99 * high}))


def test_moves_in_words(exploration):
    wish = "hinf", {"delay": 2.5, "hinf-gamma_ratio": 1.3, "robust-band": 1.0}
    moved = new_view(exploration, *wish)
    assert describe_moves(exploration, moved) == "total delay 2.5 frames, gamma ratio 1.3"
    assert describe_moves(exploration, new_view(exploration)) == ""


def test_wavefronts_in_another_unit(exploration):
    view = new_view(exploration, "kalman", {"noise": 20.0})
    with own_display_unit():
        show_in("mas", 10.0)
        assert describe_moves(exploration, view) == "measurement noise 2 mas"
        assert " mas rms, Strehl ratio" in judge(view)


def test_options_are_those_of_the_method(config):
    knobs, values = list_knobs(config), {"hinf-gamma_ratio": 1.7, "mixed-gamma_ratio": 2.0}
    _, request = fulfil("hinf", values, knobs, config)
    assert request.given == {"route": "riccati", "gamma_ratio": 1.7}
    _, request = fulfil("kalman", values, knobs, config)
    assert request.given == {}


def test_a_value_stays_within_reach_of_its_slider(config):
    knobs = list_knobs(config)
    after, _ = fulfil("kalman", {"delay": 99.0, "magic": 1.0}, knobs, config)
    assert after.hardware.delay_frames == 6.0
    assert new_view(explore(config, {}), "kalman", {"shift": -9.0}).shift_hz == -3.5
    assert new_view(explore(config, {}), "kalman").shift_hz == 0.0


def test_sliders_of_other_methods_do_not_count(config):
    knobs = list_knobs(config)
    moved = moved_knobs("integrator", {"damping": 0.01, "delay": 3.0}, knobs)
    assert [knob.key for knob in moved] == ["delay"]


def test_the_configuration_that_was_read_stays_as_it_is(config):
    before = config.text
    fulfil("robust", {"shift": 1.0, "damping": 0.01}, list_knobs(config), config)
    assert config.text == before


@pytest.fixture(scope="module")
def start():
    return lbt.load_config("examples/lbt.yaml")


def at(start, **values):
    return fulfil("kalman", values, list_knobs(start), start)[0]


def test_curves_are_those_of_the_loop(start):
    design = lbt.kalman(start.plant)
    loop = lbt.close_loop(start.hardware, design.controller)
    found = show_design(design, start, start, 0.0)
    grid = found.frequency_hz
    np.testing.assert_allclose(found.rejection, spectral_norms(loop.sensitivity(grid)))
    np.testing.assert_allclose(found.noise_transfer, spectral_norms(loop.noise_transfer(grid)))
    np.testing.assert_allclose(found.error_nm, largest_singular_values(design.error_system(), grid))
    spectrum = exact_spectrum(loop, start.truth, grid, 2048)
    np.testing.assert_allclose(found.spectrum_nm2_hz, spectrum)
    assert sorted(abs(found.poles)) == pytest.approx(sorted(abs(loop.system.poles)))
    nearest = float(np.min(np.abs(found.broken + 1)))  # of the loop gain to -1, on the grid
    assert nearest == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-2)


def test_performance_is_that_of_the_budget(start):
    design, shift = lbt.kalman(start.plant), 1.3
    config = at(start, shift=shift, gain=0.8)
    found = show_design(design, config, start, shift)
    loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=0.8)
    budget = lbt.residual_budget(loop, config.truth)
    assert found.residual_nm == pytest.approx(budget.rms_nm, rel=1e-6)
    assert found.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-6)
    assert found.modulus == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-6)
    still = at(start, gain=0.8)
    there = lbt.strehl(lbt.residual_budget(loop, still.truth), config.imaging)
    assert float(found.strehls[found.shift_hz == 0][0]) == pytest.approx(there, rel=1e-6)
    assert (found.shift_hz[0], found.shift_hz[-1]) == (-3.5, 3.5)


def test_an_unstable_loop_has_poles_only(start):
    design, config = lbt.kalman(start.plant), at(start, gain=2.4)
    found = show_design(design, config, start, 0.0)
    assert np.all(np.isnan(found.rejection))
    assert np.all(np.isnan(found.spectrum_nm2_hz))
    assert max(abs(found.poles)) > 1
    assert np.isnan([found.residual_nm, found.strehl, found.modulus]).all()
    assert np.isnan(found.strehls).all()


def test_an_integrator_estimates_nothing(start):
    assert show_design(start.design("integrator", gain=0.3), start, start, 0.0).error_nm is None


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
def five(tmp_path_factory):
    return lbt.load_config(write_config(tmp_path_factory.mktemp("five"), five_lines()))


def frequencies(lines):
    return [line.frequency_hz for line in lines]


def test_a_shift_moves_the_truth_alone(five):
    after = moved(five, shift=2.5)
    assert frequencies(after.plant.vibrations) == frequencies(five.plant.vibrations)
    expected = frequencies(five.truth.with_frequency_error(2.5).vibrations)
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
def test_what_is_assumed_leaves_the_truth(five, key, value):
    after = moved(five, **{key: value})
    for ours, theirs in zip(after.truth.vibrations, five.truth.vibrations, strict=True):
        assert (ours.frequency_hz, ours.damping) == (theirs.frequency_hz, theirs.damping)
        assert ours.direction == pytest.approx(theirs.direction, abs=1e-12)
    if key == "damping":
        assert [line.damping for line in after.plant.vibrations] == pytest.approx([0.02] * 10)
    else:
        assert len(after.plant.vibrations) == 5 * len(five.plant.vibrations)
        assert min(frequencies(after.plant.vibrations)) == pytest.approx(13 - 2 * 0.8)


def test_a_spread_can_be_taken_back(tmp_path):
    content = change_key(("model", "vibrations", 0, "spread_hz"), 1.0)
    content["model"]["vibrations"][0]["lines"] = 3
    config = lbt.load_config(write_config(tmp_path, content))
    assert len(config.plant.vibrations) == 6
    assert len(moved(config, spread=0.0).plant.vibrations) == 2


def test_the_loop_and_the_sky(five):
    after = moved(five, delay=3.25, gain=0.5, noise=40.0, seeing=1.1, wind=31.0)
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


def test_bands_widen_around_their_middles(five):
    before = moved(five, "robust")
    bands = before.method_section("robust").bands
    half = np.mean([band.high_hz - band.low_hz for band in bands]) / 2
    after = moved(five, "robust", robust__band=2 * half, robust__modulus_margin=0.3)
    section = after.method_section("robust")
    assert section.modulus_margin == 0.3
    for ours, theirs in zip(section.bands, bands, strict=True):
        assert ours.low_hz + ours.high_hz == pytest.approx(theirs.low_hz + theirs.high_hz)
        width = theirs.high_hz - theirs.low_hz
        assert ours.high_hz - ours.low_hz == pytest.approx(2 * width)
