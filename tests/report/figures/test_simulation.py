"""The simulation figure."""

import numpy as np

import lbt_synth as lbt
from lbt_synth.loop.simulation.failing_sensors import Drop, run_segments, simulate_sensors
from lbt_synth.report.figures.simulation import sensor_failure_figure, simulation_figure


def test_simulation_figure(config):
    run = lbt.simulate(
        lbt.kalman(config.plant).controller, config.truth, hardware=config.hardware, frames=600
    )
    series, spectrum = simulation_figure(run, title="Kalman").axes
    assert series.get_xlabel() == "time [s]"
    assert "[nm²/Hz]" in spectrum.get_ylabel()


def test_modes_count_from_one_as_everywhere():
    path = lbt.LoopHardware(frame_rate_hz=800, modes=3)
    truth = lbt.Truth(turbulence=None, noise_nm=5.0)
    run = lbt.simulate(lbt.integrator(path, gain=0.5).controller, truth, hardware=path, frames=256)
    figure = simulation_figure(run)
    names = [line.get_label() for line in figure.axes[0].get_lines()]
    assert names == [f"mode {i}, residual" for i in (1, 2, 3)]


def test_spans_and_levels(sensors_design, sensors_config):
    drops = [Drop(unit="m1", start_s=0.5, end_s=1), Drop(unit="m1", start_s=1.5)]
    run = simulate_sensors(
        sensors_design.controllers,
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
