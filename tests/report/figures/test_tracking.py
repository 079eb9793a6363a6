"""The figure of a tracking run."""

from __future__ import annotations

import numpy as np
import pytest
from support.figures import legend
from support.tracking import DRIFT, Oracle, axis, simulated

import lbt_synth as lbt


def test_the_figure_has_the_frequencies_and_the_residuals():
    plant = axis(18)
    tracker = lbt.identification.TrackingController(
        plant, Oracle(plant, DRIFT.frequency_hz_at, 1.0, 1.0), window_s=1, update_s=1, guarded=False
    )
    runs = {"tracking": simulated(tracker, frames=2400)}
    figure = lbt.report.figures.tracking_figure(
        tracker.history, runs, truth=[DRIFT], start_s=2.0, bin_s=0.5
    )
    upper, lower = figure.axes
    assert "[Hz]" in upper.get_ylabel()
    assert "[nm rms]" in lower.get_ylabel()
    assert lower.get_xlabel() == "time [s]"
    assert legend(upper) == ["true frequency", "the filter's", "window, at its middle"]
    drawn = lower.get_lines()[0].get_ydata()
    power = runs["tracking"].residual_nm[0, :, 0] ** 2
    assert drawn == pytest.approx(np.sqrt(power.reshape(6, 400).mean(axis=1)))
    with pytest.raises(
        lbt.errors.ProblemError, match="at least one update and one run; got 0 and 1"
    ):
        lbt.report.figures.tracking_figure([], runs)
    with pytest.raises(lbt.errors.ProblemError, match="at least 60 s long; got 3 s of 'tracking'"):
        lbt.report.figures.tracking_figure(tracker.history, runs, bin_s=60)
