"""From a wish to what the page shows."""

from types import SimpleNamespace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.linear import largest_singular_values
from lbt_synth.linear.norms import spectral_norms
from lbt_synth.report.designs.simulation import exact_spectrum
from lbt_synth.report.explore.exploration import (
    Wish,
    complete,
    describe_moves,
    explore,
    fulfil,
    judge,
    loop_curves,
    quick_view,
    whole_view,
)
from lbt_synth.report.explore.knobs import list_knobs
from lbt_synth.storage.display_unit import own_display_unit, show_in


@pytest.fixture(scope="module")
def exploration():
    config = lbt.load_config("examples/lbt.yaml")
    return explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})


def test_a_view_begins_with_its_own_design(exploration):
    view = quick_view(exploration, Wish())
    assert list(view.shown) == ["Kalman", "old"]
    assert view.name == "Kalman"
    assert not view.is_whole
    assert all(one.row is None for one in view.shown.values())
    whole = whole_view(exploration, view)
    assert whole.is_whole
    assert [one.row.design for one in whole.shown.values()] == ["Kalman", "old"]
    after = quick_view(exploration, Wish(method="hinf", values={"gain": 0.7}), whole)
    lent = [one.row for one in after.shown.values()]
    assert lent == [one.row for one in whole.shown.values()]
    assert not after.is_whole


def test_names_are_unique(exploration):
    again = explore(exploration.config, {"Kalman": lbt.kalman(exploration.config.plant)})
    assert list(quick_view(again, Wish()).shown) == ["Kalman by the sliders", "Kalman"]


def test_a_design_for_another_loop_is_refused(exploration):
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3)
    with pytest.raises(
        lbt.errors.ProblemError, match="slow must run at the configuration's 800 Hz"
    ):
        explore(exploration.config, {"slow": other})


def test_the_verdict(exploration):
    view = quick_view(exploration, Wish())
    budget = lbt.residual_budget(
        lbt.close_loop(view.config.hardware, view.design.controller), view.config.truth
    )
    text = judge(view)
    assert text.startswith(f"Kalman leaves {budget.rms_nm:.1f} nm rms, Strehl ratio 82.7 %")
    assert "above the least of any linear controller" in text
    assert "Margins: modulus 0." in text
    assert text.endswith("checks of its certificate passed.")
    unstable = quick_view(exploration, Wish(method="kalman", values={"gain": 2.4}))
    assert judge(unstable).startswith("Kalman is UNSTABLE in this loop.")


def test_moves_in_words(exploration):
    wish = Wish(method="hinf", values={"delay": 2.5, "hinf-gamma_ratio": 1.3, "robust-band": 1.0})
    assert describe_moves(exploration, wish) == "total delay 2.5 frames, gamma ratio 1.3"
    assert describe_moves(exploration, Wish()) == ""


def test_wavefronts_in_another_unit(exploration):
    view = quick_view(exploration, Wish(method="kalman", values={"noise": 20.0}))
    with own_display_unit():
        show_in("mas", 10.0)
        assert describe_moves(exploration, view.wish) == "measurement noise 2 mas"
        assert " mas rms, Strehl ratio" in judge(view)


def test_options_are_those_of_the_method(config):
    knobs, values = list_knobs(config), {"hinf-gamma_ratio": 1.7, "mixed-gamma_ratio": 2.0}
    _, request = fulfil(Wish(method="hinf", values=values), knobs, config)
    assert request.given == {"route": "riccati", "gamma_ratio": 1.7}
    _, request = fulfil(Wish(method="kalman", values=values), knobs, config)
    assert request.given == {}


def test_a_value_stays_within_reach_of_its_slider(config):
    knobs = list_knobs(config)
    after, _ = fulfil(Wish(method="kalman", values={"delay": 99.0, "magic": 1.0}), knobs, config)
    assert after.hardware.delay_frames == 6.0
    assert Wish(method="kalman", values={"shift": -9.0}).shift_hz(knobs) == -3.5
    assert Wish(method="kalman").shift_hz(knobs) == 0.0


def test_sliders_of_other_methods_do_not_count(config):
    knobs = list_knobs(config)
    wish = Wish(method="integrator", values={"damping": 0.01, "delay": 3.0})
    assert [knob.key for knob in wish.move(knobs)] == ["delay"]


def test_the_configuration_that_was_read_stays_as_it_is(config):
    before = config.text
    fulfil(
        Wish(method="robust", values={"shift": 1.0, "damping": 0.01}), list_knobs(config), config
    )
    assert config.text == before


@pytest.fixture(scope="module")
def start():
    return lbt.load_config("examples/lbt.yaml")


def at(start, **values):
    return fulfil(Wish(method="kalman", values=values), list_knobs(start), start)[0]


def left_by(design, config, start, shift_hz):
    """What a design leaves in a loop whose true lines moved by a shift."""
    view = SimpleNamespace(config=config, shift_hz=shift_hz)
    return complete(loop_curves(design, config), "K", design, view, start)


def test_curves_are_those_of_the_loop(start):
    design = lbt.kalman(start.plant)
    loop = lbt.close_loop(start.hardware, design.controller)
    found = loop_curves(design, start)
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
    found = left_by(design, config, start, shift)
    loop = lbt.close_loop(config.hardware, design.controller, sensor_gain=0.8)
    budget = lbt.residual_budget(loop, config.truth)
    assert found.row.residual_nm == pytest.approx(budget.rms_nm, rel=1e-6)
    assert found.row.strehl == pytest.approx(lbt.strehl(budget, config.imaging), rel=1e-6)
    assert found.row.modulus == pytest.approx(lbt.loop_margins(loop).modulus, rel=1e-6)
    still = at(start, gain=0.8)
    there = lbt.strehl(lbt.residual_budget(loop, still.truth), config.imaging)
    assert float(found.strehls[found.shift_hz == 0][0]) == pytest.approx(there, rel=1e-6)
    assert (found.shift_hz[0], found.shift_hz[-1]) == (-3.5, 3.5)


def test_an_unstable_loop_has_poles_only(start):
    design, config = lbt.kalman(start.plant), at(start, gain=2.4)
    found = loop_curves(design, config)
    assert np.all(np.isnan(found.rejection))
    assert np.all(np.isnan(found.spectrum_nm2_hz))
    assert max(abs(found.poles)) > 1
    left = left_by(design, config, start, 0.0)
    assert np.isnan([left.row.residual_nm, left.row.strehl, left.row.modulus]).all()
    assert np.isnan(left.strehls).all()


def test_an_integrator_estimates_nothing(start):
    assert loop_curves(start.design("integrator", gain=0.3), start).error_nm is None
