"""The command sigma: singular values of designs, and their margins."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict

from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report, tabulate
from lbt_synth.cli.output_files import require_figure
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import EstimatorDesign
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.report.figures import sigma_figure
from lbt_synth.report.figures.style import save_figure


def run(arguments: Namespace) -> Report:
    """Plot singular values of one or several designs, and print their margins."""
    require_figure(arguments.output, inputs=arguments.gains)
    designs = load_designs(arguments.gains)
    with show_spinner("drawing", quiet=arguments.json):
        figure = sigma_figure(designs, sensor_gain=arguments.sensor_gain)
    data = {}
    for name, design in designs.items():
        entry: dict[str, object] = {"method": design.method}
        if isinstance(design, EstimatorDesign):
            entry |= {"gamma": design.gamma, "rms": design.rms}
        if design.hardware is not None:
            loop = close_loop(design.hardware, design.controller, sensor_gain=arguments.sensor_gain)
            entry["stable"] = loop.is_stable
            if loop.is_stable:
                entry |= asdict(loop_margins(loop))
        data[name] = entry
    path = save_figure(figure, arguments.output)
    physical = all(design.hardware is not None for design in designs.values())
    norm = "norm [nm]" if physical else "norm"
    return Report(
        data={"designs": data, "sensor_gain": arguments.sensor_gain, "file": str(path)},
        tables=[
            tabulate(
                f"Margins at sensor gain {arguments.sensor_gain:g}",
                data,
                ("design", lambda name: name),
                (norm, lambda name: data[name].get("gamma")),
                ("stable", lambda name: data[name].get("stable")),
                ("modulus", lambda name: data[name].get("modulus")),
                ("gain from", lambda name: data[name].get("gain_low")),
                ("gain to", lambda name: data[name].get("gain_high")),
                ("phase [deg]", lambda name: data[name].get("phase_deg")),
                ("delay [frames]", lambda name: data[name].get("delay_frames")),
            )
        ],
        notes=[f"written: {path}"],
    )
