"""The figure of a run in which sensors fail."""

from __future__ import annotations

import numpy as np

import lbt_synth as lbt
from lbt_synth.loop.fusion.simulation import Drop, run_segments, simulate_fused


def test_spans_and_levels(fused, fused_config):
    drops = [Drop(unit="m1", start_s=0.5, end_s=1), Drop(unit="m1", start_s=1.5)]
    run = simulate_fused(
        fused.controllers,
        fused.problem.suite,
        fused_config.truth,
        hardware=fused_config.hardware,
        frames=2000,
        drops=drops,
    )
    segments = run_segments(drops, 2.0)
    levels = [20.0, 60.0, 20.0, np.nan]
    figure = lbt.report.figures.sensor_failure_figure(run, segments, levels)
    series, size = figure.axes
    assert len(series.patches) == len(size.patches) == 2
    drawn = [line for line in size.lines if len(line.get_xdata()) == 2]
    assert [float(line.get_ydata()[0]) for line in drawn] == [20.0, 60.0, 20.0]
