"""The closed loop: transfer functions, margins, exact residual, Strehl ratio."""

from lbt_synth.loop.budget import ResidualBudget, residual_budget
from lbt_synth.loop.closed_loop import ClosedLoop, close_loop
from lbt_synth.loop.margins import LoopMargins, loop_margins, stable_sensor_gains
from lbt_synth.loop.model import model_budget
from lbt_synth.loop.settling import settling_error
from lbt_synth.loop.strehl import Imaging, jitter_strehl, strehl, strehl_of_series
from lbt_synth.loop.youla import youla_controller

__all__ = [
    "ClosedLoop",
    "Imaging",
    "LoopMargins",
    "ResidualBudget",
    "close_loop",
    "jitter_strehl",
    "loop_margins",
    "model_budget",
    "residual_budget",
    "settling_error",
    "stable_sensor_gains",
    "strehl",
    "strehl_of_series",
    "youla_controller",
]
