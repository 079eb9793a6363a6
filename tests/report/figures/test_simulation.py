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


def test_modes_count_from_one_as_everywhere():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=3)
    truth = lbt.Truth(turbulence=None, noise_nm=5.0)
    run = lbt.simulate(lbt.integrator(path, gain=0.5).controller, truth, hardware=path, frames=256)
    figure = lbt.report.figures.simulation_figure(run)
    names = [line.get_label() for line in figure.axes[0].get_lines()]
    assert names == [f"mode {i}, residual" for i in (1, 2, 3)]
