"""From a wish to what the page shows."""

import numpy as np
import pytest
from support.configs import AR, change_key, write_config
from support.explore import five_lines
from support.plants import ROOT

import lbt_synth as lbt
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.report.explore.exploration import (
    explore,
    explored_table,
    judge,
    list_knobs,
    move,
    moved_knobs,
    new_view,
    show_design,
)
from lbt_synth.report.figures.records import exact_spectrum
from lbt_synth.storage.display_unit import own_display_unit, show_in


@pytest.fixture(scope="module")
def start():
    return lbt.load_config("examples/lbt.yaml")


@pytest.fixture(scope="module")
def exploration(start):
    return explore(start, {"old": lbt.integrator(start.hardware, gain=0.3)})


def moved(config, method="kalman", **values):
    """The configuration with sliders at values."""
    return move(config, method, moved_knobs(explore(config, {}), method, values))


def test_a_view_begins_with_its_own_design(exploration):
    view = new_view(exploration)
    assert view.name == "Kalman"
    assert view.moves == ""
    assert [row[0] for row in explored_table(view.shown).rows] == ["Kalman", "old"]
    again = explore(exploration.config, {"Kalman": lbt.kalman(exploration.config.plant)})
    assert list(new_view(again).shown) == ["Kalman by the sliders", "Kalman"]


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
    assert "WARNING: " in judge(new_view(exploration, "kalman", {"gain": 0.99 * high}))


@pytest.mark.parametrize(("gain", "thin"), [(0.6, True), (0.8, False)])
def test_a_thin_delay_margin_is_a_warning(exploration, gain, thin):
    view = new_view(exploration, "hinf", {"gain": gain})
    loop = lbt.close_loop(view.config.hardware, view.design, sensor_gain=gain)
    frames = lbt.loop_margins(loop).delay_frames
    assert (frames < 0.1) == thin
    assert (f"WARNING: {frames:.2g} frames" in judge(view)) == thin


def test_moves_in_words_and_in_the_unit_that_is_shown(exploration):
    view = new_view(exploration, "hinf", {"delay": 2.5, "gamma_ratio": 1.3, "band": 1.0})
    assert view.moves == "total delay 2.5 frames, gamma ratio 1.3"  # the band is of another method
    with own_display_unit():
        show_in("mas", 10.0)
        view = new_view(exploration, "kalman", {"noise": 20.0})
        assert view.moves == "measurement noise 2 mas"
        assert " mas rms, Strehl ratio" in judge(view)


def test_a_slider_of_a_method_is_a_key_of_its_section(start):
    exploration = explore(start, {})
    view = new_view(exploration, "hinf", {"gamma_ratio": 1.7})
    assert view.design.gamma_requested == pytest.approx(1.7 * view.design.gamma_least, rel=1e-6)
    assert view.request.given == {"route": "riccati"}
    assert list(
        moved_knobs(exploration, "integrator", {"damping": 0.01, "delay": 3.0}).values()
    ) == [3.0]


def test_a_value_stays_within_reach_of_its_slider(start):
    assert moved(start, delay=99.0, magic=1.0).hardware.delay_frames == 6.0
    assert new_view(explore(start, {}), "kalman", {"shift": -9.0}).shift_hz == -3.5
    before = start.text
    moved(start, "robust", shift=1.0, damping=0.01)
    assert start.text == before


def test_curves_are_those_of_the_loop(start):
    design = lbt.kalman(start.plant)
    loop = lbt.close_loop(start.hardware, design.controller)
    curves = show_design(design, start, start, 0.0).curves
    grid, rejection = curves["explore-rejection"]
    np.testing.assert_allclose(rejection, spectral_norms(loop.sensitivity(grid)))
    noise = spectral_norms(loop.path("noise", "residual").frequency_response(grid))
    np.testing.assert_allclose(curves["explore-noise"][1], noise)
    error = spectral_norms(design.error_system().frequency_response(grid))
    np.testing.assert_allclose(curves["explore-sigma"][1], error)
    spectrum = exact_spectrum(loop, start.truth, grid, 2048)
    np.testing.assert_allclose(curves["explore-spectrum"][1], spectrum)
    poles = np.hypot(*curves["explore-poles"])
    assert sorted(poles) == pytest.approx(sorted(abs(loop.system.poles)))
    x, y = curves["explore-nyquist"]
    assert np.isnan(x).sum() == 2  # after each of two measurements
    assert np.nanmax(np.abs(x)) <= 7.5  # a canvas takes no larger numbers
    nearest = np.nanmin(np.hypot(x + 1, y))  # of the loop gain to -1, on the grid
    assert nearest == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-2)


def test_performance_is_that_of_the_budget(start):
    design, shift = lbt.kalman(start.plant), 1.3
    config = moved(start, shift=shift, gain=0.8)
    shown = show_design(design, config, start, shift)
    loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=0.8)
    budget = lbt.residual_budget(loop, config.truth)
    assert shown.residual_nm == pytest.approx(budget.rms_nm, rel=1e-6)
    assert shown.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-6)
    assert shown.modulus == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-6)
    still = lbt.residual_budget(loop, moved(start, gain=0.8).truth)
    shifts, percents = shown.curves["explore-strehl"]
    expected = 100 * lbt.strehl(still, config.imaging)
    assert float(percents[shifts == 0][0]) == pytest.approx(expected, rel=1e-6)
    assert (shifts[0], shifts[-1]) == (-3.5, 3.5)


def test_an_unstable_loop_has_poles_only(start):
    shown = show_design(lbt.kalman(start.plant), moved(start, gain=2.4), start, 0.0)
    for key in ("rejection", "spectrum", "strehl"):
        assert np.all(np.isnan(shown.curves[f"explore-{key}"][1]))
    assert np.max(np.hypot(*shown.curves["explore-poles"])) > 1
    assert np.isnan([shown.residual_nm, shown.strehl, shown.modulus]).all()


def test_an_integrator_estimates_nothing(start):
    curves = show_design(start.design("integrator", gain=0.3), start, start, 0.0).curves
    assert "explore-sigma" not in curves


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    return lbt.load_config(write_config(tmp_path_factory.mktemp("five"), five_lines()))


def test_the_knobs_of_a_configuration(five):
    knobs = {knob.key: knob for knob in list_knobs(five)}
    loop = [key for key, knob in knobs.items() if knob.methods is None]
    assert loop == ["delay", "gain", "noise", "shift", "seeing", "wind"]
    assert knobs["gamma_ratio"].methods == {"hinf", "mixed"}
    assert knobs["spread"].methods == {"hinf", "kalman", "lqg", "mixed"}
    assert (knobs["modulus"].methods, knobs["modulus"].value) == ({"robust"}, 0.45)
    assert knobs["wind"].value == 20.0
    assert knobs["noise"].value == pytest.approx(five.noise_nm)
    for knob in knobs.values():
        assert knob.low <= knob.value <= knob.high
        assert knob.low > 0 or not knob.log


def test_what_a_configuration_does_not_have_cannot_be_moved(tmp_path):
    content = change_key(("truth", "vibrations"), [])
    del content["model"]["vibrations"], content["atmosphere"], content["end_to_end"]
    content["model"]["turbulence"] = {"kind": "ar", "coefficients": [0.99], "driving_rms_nm": 9.0}
    content["truth"]["turbulence"] = "model"
    config = lbt.load_config(write_config(tmp_path, content))
    assert [knob.key for knob in list_knobs(config)] == ["delay", "gain", "noise", "gamma_ratio"]


@pytest.mark.parametrize("example", ["lbt.yaml", "lbt_robust.yaml", "lbt_slow_mirror.yaml"])
def test_a_knob_at_its_value_changes_nothing(example):
    config = lbt.load_config(ROOT / "examples" / example)
    for name in ("kalman", "robust"):
        after = moved(config, name, **{knob.key: knob.value for knob in list_knobs(config)})
        for matrix in "ABCDL":
            ours, theirs = getattr(after.plant, matrix), getattr(config.plant, matrix)
            np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
        assert after.hardware.delay_frames == config.hardware.delay_frames
        assert after.truth.sensor_gain == pytest.approx(config.truth.sensor_gain, rel=1e-12)
        assert after.truth.noise_nm == pytest.approx(config.truth.noise_nm, rel=1e-12)
        for ours, theirs in zip(after.truth.vibrations, config.truth.vibrations, strict=True):
            assert ours.frequency_hz == theirs.frequency_hz
            assert ours.rms_nm == pytest.approx(theirs.rms_nm, rel=1e-12)
            assert ours.direction == pytest.approx(theirs.direction, abs=1e-12)


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
    bands = moved(five, "robust").method_section("robust").bands
    half = np.mean([band.high_hz - band.low_hz for band in bands]) / 2
    section = moved(five, "robust", band=2 * half, modulus=0.3).method_section("robust")
    assert section.modulus_margin == 0.3
    for ours, theirs in zip(section.bands, bands, strict=True):
        assert ours.low_hz + ours.high_hz == pytest.approx(theirs.low_hz + theirs.high_hz)
        width = theirs.high_hz - theirs.low_hz
        assert ours.high_hz - ours.low_hz == pytest.approx(2 * width)
