"""The robustness figure."""

from __future__ import annotations

from support.figures import legend

import lbt_synth as lbt


def test_robustness_figure_draws_the_paper_beside(config):
    rows = list(
        lbt.studies.robustness(config.plant, config.truth, config.imaging, errors_hz=[-1, 0, 1])
    )
    (axis,) = lbt.report.figures.robustness_figure(rows, {"kalman": [(0.0, 80.4)]}).axes
    assert legend(axis) == ["Kalman", "Kalman, paper", "H∞"]
    assert "[%]" in axis.get_ylabel()
    assert "[Hz]" in axis.get_xlabel()


def test_robustness_figure_of_an_unstable_method(config):
    from dataclasses import replace

    truth = replace(config.truth, sensor_gain=0.3)
    rows = list(
        lbt.studies.robustness(
            config.plant, truth, config.imaging, errors_hz=[-1, 0], gamma_ratio=1.05
        )
    )
    (axis,) = lbt.report.figures.robustness_figure(rows).axes
    assert legend(axis) == ["Kalman", "H∞: unstable"]
