"""The sigma plot: labels, units, marked vibrations, and loops that are unstable."""

import numpy as np
import pytest
from support.figures import legend

import lbt_synth as lbt
from lbt_synth.report.charts.description import Curve
from lbt_synth.report.figures.loop import frequency_panel


def test_sigma_figure_has_labels_units_and_marked_vibrations(designs):
    error, rejection, noise = lbt.report.figures.sigma_figure(designs).axes
    assert legend(error) == ["Kalman", "H-infinity", "vibration"]
    assert legend(rejection) == ["Kalman", "H-infinity", "integrator", "vibration"]
    assert "[nm]" in error.get_ylabel()
    assert noise.get_xlabel() == "frequency [Hz]"
    marks = [line for line in error.get_lines() if line.get_label() == "vibration"]
    assert marks[0].get_xdata()[0] == 20
    # the curve is the achieved norm at its highest point
    curve = error.get_lines()[0].get_ydata()
    assert curve.max() == pytest.approx(designs["Kalman"].gamma, rel=1e-3)


def test_curves_differ_in_grey(designs):
    lines = lbt.report.figures.sigma_figure(designs).axes[1].get_lines()[:3]
    assert len({str(line._dash_pattern) for line in lines}) == 3
    assert len({line.get_color() for line in lines}) == 3


def test_an_unstable_loop_is_named_and_not_drawn(designs):
    _, rejection, noise = lbt.report.figures.sigma_figure(designs, sensor_gain=0.4).axes
    assert "sensor gain 0.4" in rejection.get_title(loc="left")
    for axis in (rejection, noise):
        assert "H-infinity: unstable" in legend(axis)
        curves = {line.get_label(): len(line.get_xdata()) for line in axis.get_lines()}
        assert curves["H-infinity: unstable"] == 0
        assert curves["Kalman"] > 100


def test_empty_figures_are_refused():
    for empty in (
        lambda: lbt.report.figures.sigma_figure({}),
        lambda: lbt.report.figures.robustness_figure([]),
    ):
        with pytest.raises(lbt.errors.ProblemError, match="at least one"):
            empty()


def test_a_zero_at_the_nyquist_frequency_is_no_scale():
    f = np.geomspace(1, 400, 50)
    curve = Curve(name="a", x=f, y=np.abs(1 - f / 400) + 1e-17)
    panel = frequency_panel("noise to residual", "-", [curve], [])
    assert panel.y.low == pytest.approx(curve.y.max() * 1e-5)
    tame = frequency_panel("noise to residual", "-", [Curve(name="a", x=f, y=f)], [])
    assert tame.y.low is None
