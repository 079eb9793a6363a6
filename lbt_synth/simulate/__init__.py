"""The closed loop in the time domain."""

from lbt_synth.simulate.linear import filter_series
from lbt_synth.simulate.run import Simulation, simulate
from lbt_synth.simulate.series import draw_disturbance, draw_noise

__all__ = ["Simulation", "draw_disturbance", "draw_noise", "filter_series", "simulate"]
