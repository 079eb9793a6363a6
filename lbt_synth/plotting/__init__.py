"""Figures of designs, loops and studies."""

from lbt_synth.plotting.figures import (
    loop_figure,
    robustness_figure,
    sigma_figure,
    simulation_figure,
)
from lbt_synth.plotting.style import FIGURE_ENDINGS, save_figure

__all__ = [
    "FIGURE_ENDINGS",
    "loop_figure",
    "robustness_figure",
    "save_figure",
    "sigma_figure",
    "simulation_figure",
]
