"""The closed loop in the time domain."""

from lbt_synth.simulation.linear import filter_series
from lbt_synth.simulation.run import Simulation, settling_frames, simulate
from lbt_synth.simulation.series import draw_disturbance, draw_noise

__all__ = [
    "Simulation",
    "draw_disturbance",
    "draw_noise",
    "filter_series",
    "settling_frames",
    "simulate",
]
