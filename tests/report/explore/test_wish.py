"""What the page asks for, as a configuration and a request."""

import pytest

import lbt_synth as lbt
from lbt_synth.report.explore.knobs import list_knobs
from lbt_synth.report.explore.wish import Wish, fulfil


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


def test_an_unknown_method_is_refused(config):
    with pytest.raises(lbt.errors.ProblemError, match="Did you mean kalman"):
        fulfil(Wish(method="kalmann"), list_knobs(config), config)


def test_the_configuration_that_was_read_stays_as_it_is(config):
    before = config.text
    fulfil(
        Wish(method="robust", values={"shift": 1.0, "damping": 0.01}), list_knobs(config), config
    )
    assert config.text == before
