"""The command tradeoff: variance, norm and tolerated sensor gain."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.display import load_shown
from lbt_synth.cli.loop_inputs import own_sensor_notes
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import track_progress
from lbt_synth.report.figures.studies import tradeoff_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.studies import tradeoff
from lbt_synth.studies.robustness import FAMILIES
from lbt_synth.validation import integer


def run(arguments: Namespace) -> Report:
    """Design filters from the least norm to the least variance, and compare them."""
    require_outputs(arguments.output, inputs=[arguments.config])
    count = integer(arguments.points, "--points", at_least=2)
    taps = integer(arguments.taps, "--taps", at_least=1)
    config = load_shown(arguments)
    points = list(
        track_progress(
            tradeoff(config.plant.own_sensor_alone(), points=count, taps=taps),
            total=count * len(FAMILIES),
            what="filters",
            quiet=arguments.json,
        )
    )
    least = points[0].design
    report = Report()
    report.add_rows("points", "Trade-off of variance, norm and sensor gain", points)
    report.data |= {"gamma_least": least.gamma_least, "gamma_infeasible": least.gamma_infeasible}
    report.notes.append(
        f"the least norm of any filter lies between {nm_text(least.gamma_infeasible, '.9g')} and "
        f"{nm_text(least.gamma_least, '.9g')}"
    )
    report.notes += own_sensor_notes(config)
    write_outputs(report, arguments.output, points, figure=lambda: tradeoff_figure(points))
    return report
