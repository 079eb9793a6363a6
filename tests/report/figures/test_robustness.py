"""The figures of robustness, over the frequency error and as maps."""

from dataclasses import replace

import pytest
from support.figures import legend
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.studies import robustness, robustness_map


def test_robustness_figure_draws_the_paper_beside(config):
    rows = list(robustness(config.plant, config.truth, config.imaging, errors_hz=[-1, 0, 1]))
    (axis,) = lbt.report.figures.robustness_figure(rows, {"kalman": [(0.0, 80.4)]}).axes
    assert legend(axis) == ["Kalman", "Kalman, paper", "H∞"]
    assert "[%]" in axis.get_ylabel()
    assert 50 < axis.get_ylim()[0] < 80  # the scale is that of what is there
    assert "[Hz]" in axis.get_xlabel()
    (better,) = lbt.report.figures.robustness_figure(
        [replace(row, strehl=0.99 + row.strehl / 1000) for row in rows]
    ).axes
    assert 97.9 < better.get_ylim()[0] < 99


def test_robustness_figure_of_an_unstable_method(config):
    truth = replace(config.truth, sensor_gain=0.3)
    rows = list(
        robustness(config.plant, truth, config.imaging, errors_hz=[-1, 0], gamma_ratio=1.05)
    )
    (axis,) = lbt.report.figures.robustness_figure(rows).axes
    assert legend(axis) == ["Kalman", "H∞: unstable"]


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
    unstable = [[c.get_hatch() for c in p.collections].count("////") for p in (left, right)]
    assert unstable == [1, 2]  # the Kalman filter at 3, the other at 0.3 as well
    assert left.collections[0].get_clim() == right.collections[0].get_clim()
    figure.savefig(tmp_path / "map.png")


def test_map_figure_of_delay_errors_and_of_few_points(kalman, robust, settings, tmp_path):
    def mapped(design, gains, delays):
        return robustness_map(
            design,
            settings.truth,
            settings.imaging,
            errors_hz=[0],
            sensor_gains=gains,
            delay_errors_frames=delays,
        )

    figure = lbt.report.figures.robustness_map_figure(
        {"a": mapped(kalman, [1], [0, 0.1]), "b": mapped(robust, [0.9], [0, 0.1])}
    )
    assert len(figure.axes) == 5
    assert figure.axes[2].get_title(loc="left") == "a, delay error +0.1 frames"
    assert figure.axes[2].get_ylabel() == "sensor gain [-]"
    figure.savefig(tmp_path / "a.png")
    nowhere = lbt.report.figures.robustness_map_figure({"a": mapped(robust, [0.1, 0.2], [0])})
    nowhere.savefig(tmp_path / "b.pdf")


def test_map_figures_that_are_refused(maps, kalman, settings):
    with pytest.raises(lbt.errors.ProblemError, match="at least one map"):
        lbt.report.figures.robustness_map_figure({})
    late = robustness_map(
        kalman,
        settings.truth,
        settings.imaging,
        errors_hz=[0],
        sensor_gains=[1],
        delay_errors_frames=[0.1],
    )
    with pytest.raises(
        lbt.errors.ProblemError, match=r"same delay errors \[0.0\]; got \[0.1\] for late"
    ):
        lbt.report.figures.robustness_map_figure({**maps, "late": late})
