"""The command nichols: gain over phase of loops, with their margins."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.loop_views import LoopPoint, loop_points, show_view
from lbt_synth.cli.output import Report
from lbt_synth.report.figures import nichols_figure


def run(arguments: Namespace) -> Report:
    """Draw gain over phase of loops, and print their margins."""
    return show_view(arguments, nichols_figure, loop_points, LoopPoint)
