"""Figures of studies: robustness, maps, limits, trade-offs, modes, and end-to-end tables."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from support.figures import legend

import lbt_synth as lbt
from lbt_synth.report.figures.studies import (
    frame_rate_figure,
    limits_figure,
    modal_figure,
    robustness_figure,
    tradeoff_figure,
)
from lbt_synth.studies import robustness, robustness_map
from lbt_synth.studies.limits import limits


def test_residuals_over_the_frame_rate_have_logarithmic_axes():
    residuals_nm = {"integrator": np.array([900.0, 100.0]), "limit": np.array([140.0, 20.0])}
    (axis,) = frame_rate_figure([200.0, 2000.0], residuals_nm).axes
    assert legend(axis) == ["integrator", "limit"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("frame rate [Hz]", "residual [nm rms]")
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    drawn = [line.get_ydata() for line in axis.get_lines()]
    assert np.array_equal(drawn, list(residuals_nm.values()))


def test_robustness_figure_draws_the_paper_beside(config):
    rows = list(robustness(config.plant, config.truth, config.imaging, errors_hz=[-1, 0, 1]))
    (axis,) = robustness_figure(rows, {"kalman": [(0.0, 80.4)]}).axes
    assert legend(axis) == ["Kalman", "Kalman, paper", "H∞"]
    assert "[%]" in axis.get_ylabel()
    assert 50 < axis.get_ylim()[0] < 81  # the scale is that of what is there
    assert "[Hz]" in axis.get_xlabel()
    high = [replace(r, values=r.values | {"strehl": 0.99 + r.strehl / 1000}) for r in rows]
    (better,) = robustness_figure(high, {}).axes
    assert 98.9 < better.get_ylim()[0] < 99.5


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
    assert shade.get_paths()[0].vertices[:, 1].min() == axes.get_ylim()[0] > 0.01


def test_a_map_hatches_the_unstable_region(config, lbt_designs):
    axes = {"errors_hz": [2, 0, -2, 1], "sensor_gains": [1.5, 0.3, 0.8, 3.0]}
    maps = {
        name: robustness_map(lbt_designs[name], config.truth, config.imaging, **axes)
        for name in ("kalman", "hinf")
    }
    left, right, bar = lbt.report.figures.robustness_map_figure(maps).axes
    assert [panel.get_title(loc="left") for panel in (left, right)] == ["kalman", "hinf"]
    labels = bar.get_xlabel(), left.get_xlabel(), left.get_ylabel()
    assert labels == (
        "Strehl ratio [%]",
        "frequency error, truth less design [Hz]",
        "sensor gain [-]",
    )
    assert [panel.patch.get_hatch() for panel in (left, right)] == ["////"] * 2
    blank = [np.ma.count_masked(panel.collections[0].get_array()) for panel in (left, right)]
    assert blank == [4, 8]  # the Kalman filter at 3, the other at 0.3 as well
    assert left.collections[0].get_clim() == right.collections[0].get_clim()


def test_modal_figure_has_all_modes():
    residuals = {"integrators": np.array([9.0, 5, 2]), "Kalman filters": np.array([8.0, 4, 1])}
    facts = {"gains": np.array([0.5, 0.4, 0.3]), "turbulence_nm": np.array([90.0, 50.0, 20.0])}
    above, below = modal_figure(residuals, **facts).axes
    assert (above.get_ylabel(), below.get_ylabel()) == ("integrator gain", "residual [nm rms]")
    assert [line.get_label() for line in below.get_lines()] == ["turbulence", *residuals]
    for line, values in zip(below.get_lines()[1:], residuals.values(), strict=True):
        np.testing.assert_array_equal(line.get_xydata().T, [[1, 2, 3], values])
    (gains,) = above.get_lines()
    assert gains.get_color() not in [line.get_color() for line in below.get_lines()]


def test_limits_name_designs_and_what_moves(config, lbt_designs):
    designs = {"kalman": lbt_designs["kalman"], "slow": lbt_designs["integrator"]}
    study = limits(designs, config.hardware, config.truth, config.imaging, errors_hz=[-1, 1])
    (axes,) = limits_figure(study).axes
    assert legend(axes)[:2] == ["Kalman", "slow"]
    assert axes.get_xlabel() == "frequency of the true vibration [Hz]"
    assert axes.get_ylabel() == "residual [nm rms]"
    assert len({str(line.get_linestyle()) for line in axes.get_lines()[:2]}) == 2
    several = limits_figure(replace(study, frequency_hz=None)).axes[0].get_xlabel()
    assert several == "shift of the vibration that moves most, the others in proportion [Hz]"
