"""The commands that draw loops: bode, nyquist, nichols, sigma and step.

They print the margins of the loops, and write the curves as data.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.cli.display import choose_design_unit
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import Design
from lbt_synth.errors import UnstableLoopError
from lbt_synth.loop import LoopMargins, close_loop, loop_margins
from lbt_synth.report.figures import (
    bode_figure,
    nichols_figure,
    nyquist_figure,
    sigma_figure,
    step_figure,
)
from lbt_synth.report.figures.open_loops import axes_name, open_loops
from lbt_synth.report.figures.sigma import sigma_curves
from lbt_synth.report.figures.step import design_steps
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import column, columns, json_record, json_units, table_row

_SETTLING_FRAMES = 8000  # within which loops settle, beyond what is drawn


@table_row
class LoopPoint:
    """The loop of a design, broken at one measurement, at one frequency."""

    design: str = column("design", help="Name of the design, with its axes where they differ")
    frequency_hz: float = column("frequency", unit="Hz", help="Frequency")
    gain_db: float = column("loop gain", unit="dB", help="Gain")
    phase_deg: float = column("phase", unit="deg", help="Phase without jumps, with the delay")
    real: float = column("real part", help="Real part of the loop")
    imaginary: float = column("imaginary part", help="Imaginary part of the loop")


@table_row
class SigmaPoint:
    """Largest singular values of a design at one frequency; nan for what it does not have."""

    design: str = column("design", help="Name of the design")
    frequency_hz: float = column("frequency", unit="Hz", help="Frequency")
    error: float = column("disturbances to error", help="Of the estimation error; nm of a loop")
    rejection: float = column("phase to residual", help="Of the rejection")
    noise_transfer: float = column("noise to residual", help="Of the noise transfer")


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
    """Print the margins of designs, and write their figure and their points."""
    figure, points, kind = _VIEWS[arguments.command]
    require_outputs(arguments.output, inputs=arguments.gains)
    designs, gain = load_designs(arguments.gains), arguments.sensor_gain
    choose_design_unit(arguments, *designs.values())
    report = Report()
    with show_spinner("drawing", quiet=arguments.json):
        add_margins(report, designs, gain)
        found = points(designs, gain)
        if not found:
            raise UnstableLoopError(
                f"no loop is stable at sensor gain {gain:g}, and there is nothing to draw; "
                "lbt-synth show prints the gains that are stable."
            )
        report.data["curves"] = _curves(found, kind)
        report.data["units"] |= json_units(kind)
        write_outputs(
            report, arguments.output, found, figure=lambda: figure(designs, sensor_gain=gain)
        )
    if arguments.command == "step":
        _add_step_facts(report, designs, gain)
    return report


def _curves(points: Sequence[Any], kind: type[Any]) -> dict[str, dict[str, list[float]]]:
    """Return lists of the numbers of each design; what it has none of is left out."""
    names = [field.name for field in fields(kind) if field.name != "design"]
    curves: dict[str, dict[str, list[float]]] = {}
    for point in points:
        own = curves.setdefault(point.design, {name: [] for name in names})
        for name in names:
            own[name].append(getattr(point, name))
    return {
        design: {name: values for name, values in own.items() if not np.isnan(values).all()}
        for design, own in curves.items()
    }


def add_margins(report: Report, designs: Mapping[str, Design], sensor_gain: float) -> None:
    """Add the margins of designs, side by side."""
    margins = {name: _margins(design, sensor_gain) for name, design in designs.items()}
    physical = all(design.hardware is not None for design in designs.values())
    units = json_units(LoopMargins) | ({"gamma": "nm", "rms": "nm"} if physical else {})
    report.data |= {"designs": margins, "units": units, "sensor_gain": sensor_gain}
    shown = [each for each in columns(LoopMargins) if each.heading]
    unit, factor = shown_unit(units.get("gamma", ""))
    norms = [factor * known["gamma"] if "gamma" in known else None for known in margins.values()]
    quantities = [("stable", "stable", "")]
    quantities += [(each.heading, each.key, each.shown_unit) for each in shown]
    report.add_table(
        f"Margins at sensor gain {sensor_gain:g}",
        ("quantity", *margins, "unit"),
        [("norm", *norms, unit)]
        + [
            (heading, *(known.get(key) for known in margins.values()), unit)
            for heading, key, unit in quantities
        ],
    )


def _margins(design: Design, sensor_gain: float) -> dict[str, Any]:
    """Return what is known of a design: its norm in its model, and the margins of its loop."""
    known: dict[str, Any] = {"method": design.method}
    if design.is_estimator:
        known |= {"gamma": design.gamma, "rms": design.rms}
    if design.hardware is not None:
        loop = close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
        known["stable"] = loop.is_stable
        if loop.is_stable:
            known |= json_record(loop_margins(loop))
    return known


def _loop_points(designs: Mapping[str, Design], sensor_gain: float) -> list[LoopPoint]:
    """Return the points of the loops of designs."""
    return [
        LoopPoint(
            design=each.name,
            frequency_hz=float(frequency),
            gain_db=float(gain),
            phase_deg=float(phase),
            real=float(value.real),
            imaginary=float(value.imag),
        )
        for each in open_loops(designs, sensor_gain=sensor_gain)
        for frequency, gain, phase, value in zip(*each.points, strict=True)
    ]


def _sigma_points(designs: Mapping[str, Design], sensor_gain: float) -> list[SigmaPoint]:
    """Return the points of the curves of designs."""
    points = []
    for name, curves in sigma_curves(designs, sensor_gain=sensor_gain).items():
        f, *parts = curves
        values = [np.full(f.size, np.nan) if part is None else part for part in parts]
        points += [
            SigmaPoint(
                design=name,
                frequency_hz=float(frequency),
                error=float(error),
                rejection=float(rejection),
                noise_transfer=float(noise),
            )
            for frequency, error, rejection, noise in zip(f, *values, strict=True)
        ]
    return points


def _add_step_facts(report: Report, designs: Mapping[str, Design], sensor_gain: float) -> None:
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


def _step_points(designs: Mapping[str, Design], sensor_gain: float) -> list[StepPoint]:
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


_View: TypeAlias = tuple[
    Callable[..., Any], Callable[[Mapping[str, Design], float], Sequence[Any]], type[Any]
]
_VIEWS: Mapping[str, _View] = {  # the figure, the points of its curves, and their type
    "bode": (bode_figure, _loop_points, LoopPoint),
    "nyquist": (nyquist_figure, _loop_points, LoopPoint),
    "nichols": (nichols_figure, _loop_points, LoopPoint),
    "sigma": (sigma_figure, _sigma_points, SigmaPoint),
    "step": (step_figure, _step_points, StepPoint),
}
