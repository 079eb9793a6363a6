"""The simulation figure."""

from __future__ import annotations

import lbt_synth as lbt


def test_simulation_figure(config):
    run = lbt.simulate(
        lbt.kalman(config.plant).controller, config.truth, hardware=config.hardware, frames=600
    )
    series, spectrum = lbt.report.figures.simulation_figure(run, title="Kalman").axes
    assert series.get_xlabel() == "time [s]"
    assert "[nm²/Hz]" in spectrum.get_ylabel()
