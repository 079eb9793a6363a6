"""The command nyquist: loops in the complex plane, with their margins."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.loop_views import LoopPoint, loop_points, show_view
from lbt_synth.cli.output import Report
from lbt_synth.report.figures import nyquist_figure


def run(arguments: Namespace) -> Report:
    """Draw loops in the complex plane, and print their margins."""
    return show_view(arguments, nyquist_figure, loop_points, LoopPoint)
