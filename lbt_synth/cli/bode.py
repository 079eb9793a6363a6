"""The command bode: gain and phase of loops over frequency, with their margins."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.loop_views import LoopPoint, loop_points, show_view
from lbt_synth.cli.output import Report
from lbt_synth.report.figures import bode_figure


def run(arguments: Namespace) -> Report:
    """Draw gain and phase of loops over frequency, and print their margins."""
    return show_view(arguments, bode_figure, loop_points, LoopPoint)
