"""The command sigma: singular values of designs, and their margins."""

from __future__ import annotations

from argparse import Namespace
from typing import Any

from lbt_synth.cli.display import choose_design_unit
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_figure
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import Design, EstimatorDesign
from lbt_synth.loop import LoopMargins, close_loop, loop_margins
from lbt_synth.report.figures import sigma_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import columns, json_record, json_units


def run(arguments: Namespace) -> Report:
    """Plot singular values of one or several designs, and print their margins."""
    require_figure(arguments.output, inputs=arguments.gains)
    designs = load_designs(arguments.gains)
    choose_design_unit(arguments, *designs.values())
    with show_spinner("drawing", quiet=arguments.json):
        figure = sigma_figure(designs, sensor_gain=arguments.sensor_gain)
    margins = {name: _margins(design, arguments.sensor_gain) for name, design in designs.items()}
    physical = all(design.hardware is not None for design in designs.values())
    units = json_units(LoopMargins) | ({"gamma": "nm", "rms": "nm"} if physical else {})
    report = Report(data={"designs": margins, "units": units, "sensor_gain": arguments.sensor_gain})
    shown = [each for each in columns(LoopMargins) if each.heading]
    unit, factor = shown_unit(units.get("gamma", ""))
    norms = [factor * known["gamma"] if "gamma" in known else None for known in margins.values()]
    quantities = [("stable", "stable", "")]
    quantities += [(each.heading, each.key, each.shown_unit) for each in shown]
    report.add_table(
        f"Margins at sensor gain {arguments.sensor_gain:g}",
        ("quantity", *margins, "unit"),
        [("norm", *norms, unit)]
        + [
            (heading, *(known.get(key) for known in margins.values()), unit)
            for heading, key, unit in quantities
        ],
    )
    report.note_written(save_figure(figure, arguments.output))
    return report


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
