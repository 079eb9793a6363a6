"""The figures of the page of sliders."""

from dataclasses import replace

import numpy as np
import pytest

import lbt_synth as lbt
from lbt_synth.report.explore.exploration import explore, quick_view, whole_view
from lbt_synth.report.explore.panels import LivePanel, explore_numbers

LOOKS = {"Kalman": 0, "old": 1}


@pytest.fixture(scope="module")
def view():
    config = lbt.load_config("examples/lbt.yaml")
    exploration = explore(config, {"old": lbt.integrator(config.hardware, gain=0.3)})
    return whole_view(exploration, quick_view(exploration, values={"shift": 1.0}))


@pytest.fixture(scope="module")
def numbers(view):
    found = explore_numbers(view.shown, view.config.truth.lines_hz, view.shift_hz)
    return {key.removeprefix("explore-"): value for key, value in found.items()}


def test_every_design_is_in_every_figure_that_it_has(numbers):
    for key, (curves, _, _) in numbers.items():
        assert set(curves) == ({"Kalman"} if key == "sigma" else {"Kalman", "old"}), key


def test_rules_mark_the_lines_and_the_slider(numbers):
    assert list(numbers["noise"][1]) == [21.0]
    assert list(numbers["strehl"][1]) == [1.0]


def test_the_strehl_scale_is_that_of_what_is_there(numbers):
    curves, _, (_, (low, _)) = numbers["strehl"]
    least = min(float(np.min(y)) for _, y in curves.values())
    assert least > 15
    assert least - 15 < low <= least


def test_scales_end_at_decades(numbers):
    for key, decades in (("rejection", 4), ("noise", 2), ("spectrum", 4), ("sigma", 2)):
        curves, _, (_, (low, high)) = numbers[key]
        highest = max(float(np.max(y)) for _, y in curves.values())
        assert highest < high < 12 * max(highest, 1.0)
        assert low == pytest.approx(high / 10**decades)
        assert np.log10(high) == pytest.approx(round(np.log10(high)))


def test_an_unstable_loop_has_scales(view):
    nothing = np.full(3, np.nan)
    lost = {name: np.full(one.frequency_hz.size, np.nan) for name, one in view.shown.items()}
    shown = {
        name: replace(one, rejection=lost[name], shift_hz=np.arange(3.0), strehls=nothing)
        for name, one in view.shown.items()
    }
    for _, _, ends in explore_numbers(shown, (), 0.0).values():
        assert np.isfinite(ends).all()
        assert all(low < high for low, high in ends)


def test_the_plane_of_the_loop_gain_stays_small(numbers):
    curves, _, ends = numbers["nyquist"]
    x, _ = curves["Kalman"]
    assert np.nanmax(np.abs(x)) <= 9.0
    assert np.isnan(x).sum() == 2  # after each of two measurements
    assert ends == ((-4.0, 2.0), (-3.0, 3.0))


def figure_of(live):
    ((figure, _, _),) = live.root.children
    return figure


def own(heights, *, at=2.0, high=10.0):
    x = np.arange(1.0, 1.0 + len(heights))
    return {"Kalman": (x, np.array(heights))}, [at], ((1.0, 4.0), (0.1, high))


def test_new_numbers_go_to_the_same_figure():
    live = LivePanel("explore-noise")
    live.show(own([1.0, 2.0, -1.0]), LOOKS)
    figure = figure_of(live)
    rule, line = figure.renderers[0].data_source, figure.renderers[1].data_source
    np.testing.assert_array_equal(line.data["y0"], [1.0, 2.0, np.nan])  # none on this scale
    live.show(own([3.0, 4.0, 5.0, 6.0], at=3.0), LOOKS)
    assert figure_of(live) is figure
    np.testing.assert_array_equal(line.data["y0"], [3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(rule.data["at"], [3.0])


def test_what_is_the_same_is_not_sent():
    live, sent = LivePanel("explore-noise"), []
    live.show(own([1.0, 2.0]), LOOKS)
    for renderer in figure_of(live).renderers[:2]:
        renderer.data_source.on_change("data", lambda attr, old, new: sent.append(1))
    live.show(own([1.0, 2.0], at=3.0), LOOKS)
    assert sent == [1]


def test_scales_follow():
    live = LivePanel("explore-noise")
    live.show(own([1.0, 2.0]), LOOKS)
    figure = figure_of(live)
    live.show(own([1.0, 2.0], high=100.0), LOOKS)
    assert figure_of(live) is figure
    assert (figure.y_range.start, figure.y_range.end) == (0.1, 100.0)


def test_other_designs_make_another_figure():
    live, shown = LivePanel("explore-noise"), own([1.0, 2.0])
    live.show(shown, LOOKS)
    figure = figure_of(live)
    live.show(shown, {"Kalman": 1})
    assert figure_of(live) is not figure
    live.show(({**shown[0], "old": shown[0]["Kalman"]}, *shown[1:]), LOOKS)
    lines = figure_of(live).renderers[1:]
    assert [one.name for one in lines] == ["design Kalman", "design old"]
    assert lines[0].data_source is lines[1].data_source  # sent once
