"""Figures of studies: robustness, maps, limits, trade-offs, modes, and end-to-end tables."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.figures import legend
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.report.figures.studies import (
    limits_figure,
    modal_figure,
    robustness_figure,
    tradeoff_figure,
)
from lbt_synth.studies import robustness, robustness_map
from lbt_synth.studies.limits import limits


def test_robustness_figure_draws_the_paper_beside(config):
    rows = list(robustness(config.plant, config.truth, config.imaging, errors_hz=[-1, 0, 1]))
    (axis,) = robustness_figure(rows, {"kalman": [(0.0, 80.4)]}).axes
    assert legend(axis) == ["Kalman", "Kalman, paper", "H∞"]
    assert "[%]" in axis.get_ylabel()
    assert 50 < axis.get_ylim()[0] < 81  # the scale is that of what is there
    assert "[Hz]" in axis.get_xlabel()
    (better,) = robustness_figure(
        [replace(row, strehl=0.99 + row.strehl / 1000) for row in rows], {}
    ).axes
    assert 98.9 < better.get_ylim()[0] < 99.5


@pytest.fixture(scope="module")
def settings():
    return lbt.load_config(LBT_YAML)


@pytest.fixture(scope="module")
def kalman(settings):
    return lbt.kalman(settings.plant)


@pytest.fixture(scope="module")
def robust(settings):
    return lbt.hinf(settings.plant, gamma_ratio=1.2, route="riccati")


@pytest.fixture(scope="module")
def maps(kalman, robust, settings):
    axes = {"errors_hz": [2, 0, -2, 1], "sensor_gains": [1.5, 0.3, 0.8, 3.0]}
    return {
        name: robustness_map(design, settings.truth, settings.imaging, **axes)
        for name, design in (("Kalman", kalman), ("H-infinity", robust))
    }


def test_map_figure_has_labels_units_and_the_unstable_region(maps, tmp_path):
    figure = lbt.report.figures.robustness_map_figure(maps)
    left, right, bar = figure.axes
    assert [panel.get_title(loc="left") for panel in (left, right)] == ["Kalman", "H-infinity"]
    assert bar.get_xlabel() == "Strehl ratio [%]"
    assert left.get_ylabel() == "sensor gain [-]"
    assert left.get_xlabel() == "frequency error, truth less design [Hz]"
    assert "unstable loop" in [text.get_text() for text in figure.legends[0].get_texts()]
    assert [panel.patch.get_hatch() for panel in (left, right)] == ["////"] * 2
    blank = [np.ma.count_masked(panel.collections[0].get_array()) for panel in (left, right)]
    assert blank == [4, 8]  # the Kalman filter at 3, the other at 0.3 as well
    assert left.collections[0].get_clim() == right.collections[0].get_clim()
    figure.savefig(tmp_path / "map.png")


def test_modal_figure_has_labels_units_and_all_modes():
    residuals = {"integrators": np.array([9.0, 5, 2]), "Kalman filters": np.array([8.0, 4, 1])}
    above, below = modal_figure(
        residuals, gains=np.array([0.5, 0.4, 0.3]), turbulence_nm=np.array([90.0, 50.0, 20.0])
    ).axes
    assert above.get_ylabel() == "integrator gain"
    assert below.get_ylabel() == "residual [nm rms]"
    assert below.get_xlabel().startswith("mode")
    assert [line.get_label() for line in below.get_lines()] == ["turbulence", *residuals]
    for line, values in zip(below.get_lines()[1:], residuals.values(), strict=True):
        assert line.get_xdata().tolist() == [1, 2, 3]
        assert line.get_ydata().tolist() == values.tolist()
    (gains,) = above.get_lines()
    assert gains.get_color() not in [line.get_color() for line in below.get_lines()]


def test_a_sensor_gain_of_zero_has_no_line():
    """The interval goes on to the edge of the panel, where it has no end."""
    points = [
        SimpleNamespace(
            family="mixed", gamma=gamma, rms=1.0, design=loop, gain_low=low, gain_high=3
        )
        for gamma, low in ((1.0, 0.5), (2.0, 0.1), (3.0, 0.0))
        for loop in [SimpleNamespace(hardware=True)]
    ]
    axes = tradeoff_figure(points).axes[1]
    low, high = (line.get_ydata() for line in axes.get_lines()[:2])
    np.testing.assert_array_equal(low, [0.5, 0.1, np.nan])
    np.testing.assert_array_equal(high, [3, 3, 3])
    (shade,) = axes.collections
    assert shade.get_paths()[0].vertices[:, 1].min() == pytest.approx(axes.get_ylim()[0])
    assert axes.get_ylim()[0] > 0.01


def test_limits_name_designs_and_what_moves(config):
    slow = lbt.integrator(config.hardware, gain=0.3)
    designs = {"kalman": lbt.kalman(config.plant), "slow": slow}
    parts = config.hardware, config.truth, config.imaging
    study = limits(designs, *parts, errors_hz=[-1, 1])
    (axes,) = limits_figure(study).axes
    assert legend(axes)[:2] == ["Kalman", "slow"]
    assert axes.get_xlabel() == "frequency of the true vibration [Hz]"
    several = limits_figure(replace(study, frequency_hz=None)).axes[0].get_xlabel()
    assert several == "shift of the vibration that moves most, the others in proportion [Hz]"
