"""The charts of the page of sliders."""

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.report.charts.description import Curve, Rule
from lbt_synth.report.charts.scales import legend_entries
from lbt_synth.report.explore.exploration import Wish, explore, first_wish, quick_view, whole_view
from lbt_synth.report.explore.panels import explore_charts


@pytest.fixture(scope="module")
def view():
    config = lbt.load_config("examples/lbt.yaml")
    exploration = explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})
    wish = Wish(method=first_wish().method, values={"shift": 1.0})
    return whole_view(exploration, quick_view(exploration, wish))


def panels(view, shift_hz=1.0):
    found = explore_charts(view.shown, view.lines_hz, shift_hz)
    return {chart.key.removeprefix("explore-"): chart.panels[0] for chart in found}


def test_every_design_is_in_every_panel_that_it_has(view):
    for key, panel in panels(view).items():
        named = {name for name in legend_entries([panel]) if name in view.shown}
        assert named == ({"Kalman"} if key == "sigma" else {"Kalman", "old"}), key
        for curve in panel.select(Curve):
            if curve.name in view.shown:
                assert curve.look == list(view.shown).index(curve.name)


def test_rules_mark_the_lines_and_the_slider(view):
    found = panels(view)
    assert [rule.at for rule in found["noise"].select(Rule)] == [21.0]
    assert [rule.at for rule in found["strehl"].select(Rule)] == [1.0]


def test_the_strehl_scale_is_that_of_what_is_there(view):
    panel = panels(view)["strehl"]
    least = min(float(np.min(c.y)) for c in panel.select(Curve))
    assert least > 15
    assert least - 15 < panel.y.low <= least
    assert len(panel.x.text) < 25  # the panels are narrow


def test_scales_end_at_decades(view):
    for key, decades in (("rejection", 4), ("noise", 2), ("spectrum", 4), ("sigma", 2)):
        panel = panels(view)[key]
        highest = max(float(np.max(c.y)) for c in panel.select(Curve) if c.name in view.shown)
        assert highest < panel.y.high < 12 * max(highest, 1.0)
        assert panel.y.low == pytest.approx(panel.y.high / 10**decades)
        assert np.log10(panel.y.high) == pytest.approx(round(np.log10(panel.y.high)))


def test_the_plane_of_the_loop_gain_stays_small(view):
    panel = panels(view)["nyquist"]
    line = next(curve for curve in panel.select(Curve) if curve.name == "Kalman")
    assert np.nanmax(np.abs(line.x)) <= 9.0
    assert np.isnan(line.x).sum() == 2  # after each of two measurements
    assert (panel.x.low, panel.x.high, panel.y.low, panel.y.high) == (-4.0, 2.0, -3.0, 3.0)
