"""Figures of designs, loops and studies."""

from lbt_synth.plotting.end_to_end import end_to_end_figure
from lbt_synth.plotting.figures import (
    loop_figure,
    robustness_figure,
    sigma_figure,
    simulation_figure,
)
from lbt_synth.plotting.front import tradeoff_figure
from lbt_synth.plotting.identification import identification_figure as identification_figure
from lbt_synth.plotting.limits import limits_figure
from lbt_synth.plotting.mirror import mirror_figure
from lbt_synth.plotting.modal import modal_figure
from lbt_synth.plotting.strehl_map import map_figure
from lbt_synth.plotting.style import FIGURE_ENDINGS, require_figure_name, save_figure
from lbt_synth.plotting.tracking import tracking_figure

__all__ = [
    "FIGURE_ENDINGS",
    "end_to_end_figure",
    "limits_figure",
    "loop_figure",
    "map_figure",
    "mirror_figure",
    "modal_figure",
    "require_figure_name",
    "robustness_figure",
    "save_figure",
    "sigma_figure",
    "simulation_figure",
    "tracking_figure",
    "tradeoff_figure",
]
