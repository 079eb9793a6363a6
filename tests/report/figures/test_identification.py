"""Labels of lines in the figure of an identified spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from support.eris import eris_model

import lbt_synth as lbt
from lbt_synth.report.charts.description import Span
from lbt_synth.report.figures.identification import identification_panels


@pytest.fixture(scope="module")
def model() -> lbt.identification.IdentifiedModel:
    return eris_model()


def test_figure_of_a_short_spectrum(model):
    figure = lbt.report.figures.identification_figure(model)
    figure.draw_without_rendering()
    labels = [text.get_text() for text in figure.axes[4].get_xticklabels() if text.get_text()]
    assert {"10", "20", "50"} <= set(labels)
    for plot, axis in zip(figure.axes[:2], model.axes, strict=True):
        assert len(plot.texts) == len(axis.lines)
        edges = plot.get_window_extent()
        places = [plot.transAxes.transform(text.get_position())[0] for text in plot.texts]
        # 6.5 points of type, and a little more
        assert np.all(np.diff(places) > 1.1 * 6.5 / 72 * figure.dpi)
        highest = np.max(
            np.interp([x.frequency_hz for x in axis.lines], axis.frequency_hz, axis.fitted_nm2_hz)
        )
        top = plot.transData.transform((10, highest))[1]
        for text in plot.texts:
            x, y = plot.transAxes.transform(text.get_position())
            assert edges.x0 < x < edges.x1
            assert y > top


def test_the_labels_of_axes_are_whole_and_beside_their_numbers(model):
    figure = lbt.report.figures.identification_figure(model)
    figure.draw_without_rendering()
    for axes in figure.axes:
        label = axes.yaxis.label.get_window_extent()
        assert label.x0 >= 0
        numbers = [text for text in axes.get_yticklabels() if text.get_text()]
        assert label.x1 <= min(text.get_window_extent().x0 for text in numbers)


def test_the_interval_of_white_noise_does_not_fill_its_panel(model):
    panel = identification_panels(model, {})[-1]
    (band,) = panel.select(Span)
    assert panel.y.high >= 2 * band.high
    assert panel.y.low <= 2 * band.low
