"""The command step: what loops do after a step of the wavefront."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Mapping

from lbt_synth.cli.loop_views import show_view
from lbt_synth.cli.output import Report
from lbt_synth.design import Design
from lbt_synth.report.figures import step_figure
from lbt_synth.report.figures.open_loops import axes_name
from lbt_synth.report.figures.step import design_steps
from lbt_synth.storage.rows import column, table_row

_SETTLING_FRAMES = 8000  # within which loops settle, beyond what is drawn


@table_row
class StepPoint:
    """A loop at one frame after a step of one."""

    design: str = column("design", help="Name of the design, with its axis where they differ")
    time_s: float = column("time", unit="s", help="Time after the step")
    residual: float = column("residual", help="Residual, as a part of the step")
    command: float = column("command", help="Command, as a part of the step")


@table_row
class StepFacts:
    """How a loop follows a step."""

    design: str = column("design", help="Name of the design, with its axis where they differ")
    overshoot_percent: float = column(
        "overshoot", unit="%", format=".1f", help="How far the correction goes beyond the step"
    )
    settling_s: float = column(
        "settling time, to 5 %",
        unit="ms",
        scale=1e3,
        format=".2f",
        help="Time after which the residual stays within 5 % of the step",
    )


def run(arguments: Namespace) -> Report:
    """Draw residual and command after a step, and print overshoot, settling time and margins."""
    return show_view(arguments, step_figure, _points, StepPoint, _add_facts)


def _add_facts(report: Report, designs: Mapping[str, Design], sensor_gain: float) -> None:
    """Add how the loops follow a step."""
    facts = [
        StepFacts(
            design=axes_name(name, [each.axis], alone=len(found) == 1),
            overshoot_percent=each.overshoot_percent,
            settling_s=each.settling_s,
        )
        for name, found in design_steps(
            designs, sensor_gain=sensor_gain, frames=_SETTLING_FRAMES
        ).items()
        for each in found
    ]
    if facts:
        report.add_rows("steps", "After a step of the wavefront", facts)


def _points(designs: Mapping[str, Design], sensor_gain: float) -> list[StepPoint]:
    """Return the points of the step responses."""
    return [
        StepPoint(
            design=axes_name(name, [each.axis], alone=len(found) == 1),
            time_s=float(time),
            residual=float(residual),
            command=float(command),
        )
        for name, found in design_steps(designs, sensor_gain=sensor_gain).items()
        for each in found
        for time, residual, command in zip(each.time_s, each.residual, each.command, strict=True)
    ]
