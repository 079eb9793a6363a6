"""Panels whose curves follow new descriptions."""

from dataclasses import replace

import numpy as np
import pytest

from lbt_synth.report.charts.bokeh_live import LivePanel
from lbt_synth.report.charts.description import Axis, Curve, Panel, Rule


def panel(heights, *, look=0, at=2.0, high=10.0):
    x = np.arange(1.0, 1.0 + len(heights))
    curve = Curve(name="a", x=x, y=np.array(heights), look=look)
    axes = {"x": Axis(label="x"), "y": Axis(label="y", log=True, low=0.1, high=high)}
    return Panel(**axes, marks=(curve, Rule(name="now", at=at)))


def figure_of(live):
    ((figure, _, _),) = live.root.children
    return figure


def test_new_numbers_go_to_the_same_figure():
    live = LivePanel("key")
    live.show(panel([1.0, 2.0, -1.0]))
    figure = figure_of(live)
    line, rule = figure.renderers[0].data_source, figure.renderers[1].data_source
    np.testing.assert_array_equal(line.data["y0"], [1.0, 2.0, np.nan])  # none on this scale
    live.show(panel([3.0, 4.0, 5.0, 6.0], at=3.0))
    assert figure_of(live) is figure
    np.testing.assert_array_equal(line.data["y0"], [3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(rule.data["at"], [3.0])


def test_what_is_the_same_is_not_sent():
    live, sent = LivePanel("key"), []
    live.show(panel([1.0, 2.0]))
    for renderer in figure_of(live).renderers[:2]:
        renderer.data_source.on_change("data", lambda attr, old, new: sent.append(1))
    live.show(panel([1.0, 2.0], at=3.0))
    assert sent == [1]


def test_scales_follow():
    live = LivePanel("key")
    live.show(panel([1.0, 2.0]))
    figure = figure_of(live)
    live.show(panel([1.0, 2.0], high=100.0))
    assert figure_of(live) is figure
    assert (figure.y_range.start, figure.y_range.end) == pytest.approx((0.1, 100.0))
    assert max(figure.yaxis[0].ticker.ticks) == pytest.approx(100.0)


def test_other_marks_make_another_figure():
    live, shown = LivePanel("key"), panel([1.0, 2.0])
    live.show(shown)
    figure = figure_of(live)
    live.show(panel([1.0, 2.0], look=1))
    assert figure_of(live) is not figure
    live.show(replace(shown, marks=(*shown.marks, Rule(name="", at=1.0, axis="y"))))
    assert len(figure_of(live).renderers) == 4
