"""What the commands that draw loops share: their margins as a table, and their curves as data."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from lbt_synth.cli.display import choose_design_unit
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.errors import UnstableLoopError
from lbt_synth.loop import LoopMargins, close_loop, loop_margins
from lbt_synth.report.figures.open_loops import open_loops
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import column, columns, json_record, json_units, table_row


@table_row
class LoopPoint:
    """The loop of a design, broken at one measurement, at one frequency."""

    design: str = column("design", help="Name of the design, with its axes where they differ")
    frequency_hz: float = column("frequency", unit="Hz", help="Frequency")
    gain_db: float = column("loop gain", unit="dB", help="Gain")
    phase_deg: float = column("phase", unit="deg", help="Phase without jumps, with the delay")
    real: float = column("real part", help="Real part of the loop")
    imaginary: float = column("imaginary part", help="Imaginary part of the loop")


def loop_points(designs: Mapping[str, Design], sensor_gain: float) -> list[LoopPoint]:
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


def show_view(
    arguments: Namespace,
    figure: Callable[..., Any],
    points: Callable[[Mapping[str, Design], float], Sequence[Any]],
    kind: type[Any],
    add_more: Callable[[Report, Mapping[str, Design], float], None] = lambda *_: None,
) -> Report:
    """Print the margins of designs, and write their figure and their points, rows of a kind."""
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
    add_more(report, designs, gain)
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
    if isinstance(design, EstimatorDesign):
        known |= {"gamma": design.gamma, "rms": design.rms}
    if design.hardware is not None:
        loop = close_loop(design.hardware, design.controller, sensor_gain=sensor_gain)
        known["stable"] = loop.is_stable
        if loop.is_stable:
            known |= json_record(loop_margins(loop))
    return known
