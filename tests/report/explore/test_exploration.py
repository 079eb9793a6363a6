"""From a wish to what the page shows."""

import pytest

import lbt_synth as lbt
from lbt_synth.report.explore.exploration import (
    Wish,
    describe_moves,
    explore,
    first_wish,
    fulfil,
    judge,
    quick_view,
    whole_view,
)
from lbt_synth.report.explore.knobs import list_knobs
from lbt_synth.storage.display_unit import DisplayUnit, own_display_unit, show_in


@pytest.fixture(scope="module")
def exploration():
    config = lbt.load_config("examples/lbt.yaml")
    return explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})


def test_a_view_begins_with_its_own_design(exploration):
    view = quick_view(exploration, first_wish())
    assert list(view.shown) == ["Kalman", "old"]
    assert view.name == "Kalman"
    assert not view.is_whole
    assert all(one.performance is None for one in view.shown.values())
    whole = whole_view(exploration, view)
    assert whole.is_whole
    assert [one.performance.row.design for one in whole.shown.values()] == ["Kalman", "old"]
    after = quick_view(exploration, Wish(method="hinf", values={"gain": 0.7}), whole)
    lent = [one.performance for one in after.shown.values()]
    assert lent == [one.performance for one in whole.shown.values()]
    assert not after.is_whole


def test_names_are_unique(exploration):
    again = explore(exploration.config, {"Kalman": lbt.kalman(exploration.config.plant)})
    assert list(quick_view(again, first_wish()).shown) == ["Kalman by the sliders", "Kalman"]


def test_a_design_for_another_loop_is_refused(exploration):
    other = lbt.integrator(lbt.LoopHardware(frame_rate_hz=500), gain=0.3)
    with pytest.raises(
        lbt.errors.ProblemError, match="slow must run at the configuration's 800 Hz"
    ):
        explore(exploration.config, {"slow": other})


def test_the_verdict(exploration):
    view = quick_view(exploration, first_wish())
    budget = lbt.residual_budget(
        lbt.close_loop(view.config.hardware, view.design.controller), view.config.truth
    )
    text = judge(view)
    assert text.startswith(f"Kalman leaves {budget.rms_nm:.1f} nm rms, Strehl ratio 83.6 %")
    assert "above the least of any linear controller" in text
    assert "Margins: modulus 0." in text
    assert text.endswith("checks of its certificate passed.")
    unstable = quick_view(exploration, Wish(method="kalman", values={"gain": 2.4}))
    assert judge(unstable).startswith("Kalman is UNSTABLE in this loop.")


def test_moves_in_words(exploration):
    wish = Wish(method="hinf", values={"delay": 2.5, "hinf-gamma_ratio": 1.3, "robust-band": 1.0})
    assert describe_moves(exploration, wish) == "total delay 2.5 frames, gamma ratio 1.3"
    assert describe_moves(exploration, first_wish()) == ""


def test_wavefronts_in_another_unit(exploration):
    view = quick_view(exploration, Wish(method="kalman", values={"noise": 20.0}))
    with own_display_unit():
        show_in(DisplayUnit(name="mas", nm=10.0))
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
