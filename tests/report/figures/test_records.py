"""Figures of runs in time, and labels of lines in the figure of an identified spectrum."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.eris import eris_model

import lbt_synth as lbt
from lbt_synth.loop.simulation import Drop, run_segments
from lbt_synth.report.figures.records import (
    exact_spectrum,
    run_spectra,
    sensor_failure_figure,
    simulation_figure,
    spread_labels,
)


@pytest.fixture(scope="module")
def model():
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


@given(st.lists(st.floats(0, 1), max_size=40))
def test_labels_do_not_overlap(wanted):
    wanted = sorted(wanted)
    places = spread_labels(np.array(wanted), 0.045)
    gap = min(0.045, 1 / max(len(wanted), 1))
    assert places.size == len(wanted)
    assert np.all(np.diff(places) > gap - 1e-9)
    assert np.all((places > 0) & (places < 1))
    if wanted and np.all(np.diff([-0.03, *wanted, 1.03]) > 0.06):
        assert places == pytest.approx(wanted)


def test_a_simulation_has_the_spectrum_of_the_transfer_functions(config, lbt_designs):
    design = lbt_designs["kalman"]
    run = lbt.simulate(
        design.controller, config.truth, hardware=config.hardware, frames=4000, cases=2
    )
    series, spectrum = simulation_figure(run, title="Kalman").axes
    assert series.get_xlabel() == "time [s]"
    assert "[nm²/Hz]" in spectrum.get_ylabel()
    f, _, simulated = run_spectra(run)
    loop = lbt.close_loop(config.hardware, design.controller)
    ratio = (simulated / exact_spectrum(loop, config.truth, f, 2048))[f > 5]
    assert np.mean(ratio) == pytest.approx(1, abs=0.06)


def test_spans_and_levels(sensors_design, sensors_config):
    drops = [Drop(unit="m1", start_s=0.5, end_s=1), Drop(unit="m1", start_s=1.5)]
    run = lbt.simulate(
        sensors_design,
        sensors_config.truth,
        hardware=sensors_design.hardware,
        frames=2000,
        drops=drops,
    )
    segments = run_segments(drops, 2.0)
    levels = [20.0, 60.0, 20.0, np.nan]
    figure = sensor_failure_figure(run, segments, levels)
    series, size = figure.axes
    assert len(series.patches) == len(size.patches) == 2
    drawn = [line for line in size.lines if len(line.get_xdata()) == 2]
    assert [float(line.get_ydata()[0]) for line in drawn] == [20.0, 60.0, 20.0]
    (mean,) = [line.get_ydata() for line in size.lines if len(line.get_xdata()) == 20]
    assert np.mean(np.square(mean)) == pytest.approx(float(run.rms_nm[0]) ** 2)  # as exact ones


def test_the_exact_spectrum_has_the_exact_power():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    design = lbt.integrator(path, gain=0.4)
    slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=10.0, frame_rate_hz=800)
    shake = lbt.Vibration(frequency_hz=60, damping=0.05, rms_nm=40, direction=(1,))
    line = lbt.models.SinusoidalVibration(frequency_hz=31.7, rms_nm=30.0, direction=(1,))
    truth = lbt.Truth(turbulence=slow, vibrations=(shake, line), noise_nm=5.0)
    loop = lbt.close_loop(path, design.controller)
    length = 2048
    grid = np.arange(length // 2 + 1) * 800 / length
    density = exact_spectrum(loop, truth, grid, length)
    power = np.sum(density[1:-1]) * 800 / length  # the ends hold half a bin
    exact = lbt.residual_budget(loop, truth)
    means_nm = np.sqrt(exact.rms_nm**2 - exact.within_nm**2)
    assert np.sqrt(power) == pytest.approx(means_nm, rel=2e-3)
