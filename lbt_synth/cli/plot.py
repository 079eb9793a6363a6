"""The command plot: margins of loops, and sigma, bode, nyquist, nichols or step curves."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.cli.loop_inputs import choose_design_unit, load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner
from lbt_synth.design import Design
from lbt_synth.errors import UnstableLoopError
from lbt_synth.loop import LoopMargins, close_loop, loop_margins
from lbt_synth.loop.simulation.run import SHOWN_FRAMES, LoopStep
from lbt_synth.report.figures import loop_figure
from lbt_synth.report.figures.loops import (
    axes_name,
    closed_loops,
    design_steps,
    loop_points,
    open_loops,
    sigma_curves,
)
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import Column, Facts, columns, fact, facts, json_record, json_units
from lbt_synth.validation import FloatArray

_SETTLING_FRAMES = 8000  # within which loops settle, beyond what is drawn


_LOOP = (  # the loop of a design, broken at one measurement
    ("frequency_hz", Column(heading="frequency", unit="Hz")),
    ("gain_db", Column(heading="loop gain", unit="dB")),
    ("phase_deg", Column(heading="phase", unit="deg")),  # without jumps, with the delay
    ("real", Column(heading="real part")),
    ("imaginary", Column(heading="imaginary part")),
)
_SIGMA = (  # largest singular values; nan for what a design does not have
    ("frequency_hz", Column(heading="frequency", unit="Hz")),
    ("error", Column(heading="disturbances to error")),  # nm of a loop
    ("rejection", Column(heading="phase to residual")),
    ("noise_transfer", Column(heading="noise to residual")),
)
_STEP = (  # after a step of the wavefront, as parts of it
    ("time_s", Column(heading="time", unit="s")),
    ("residual", Column(heading="residual")),
    ("command", Column(heading="command")),
)


def run(arguments: Namespace) -> Report:
    """Print the margins of designs, and write their figure and their points."""
    view = arguments.kind
    points = _POINTS.get(view, _loop_points)
    require_outputs(arguments.output, inputs=arguments.gains)
    designs, gain = load_designs(arguments.gains), arguments.gain_factor
    choose_design_unit(arguments, *designs.values())
    report = Report()
    with show_spinner("drawing", quiet=arguments.json):
        _add_margins(report, designs, gain)
        drawn = points(designs, gain)
        if not drawn:
            raise UnstableLoopError(
                f"no loop is stable at {gain:g} times the sensor gain that its design assumes, and "
                "there is nothing to draw; lbt-synth show prints the factors that are stable."
            )
        report.data["curves"] = _curves(drawn)
        report.data["units"] |= json_units(drawn[0])
        write_outputs(
            report,
            arguments.output,
            drawn,
            figure=lambda: loop_figure(designs, view, sensor_gain=gain),
        )
    if view == "step":
        _add_step_facts(report, designs, gain)
    return report


def _curves(points: Sequence[Facts]) -> dict[str, dict[str, list[float]]]:
    """Return lists of the numbers of each design; what it has none of is left out."""
    curves: dict[str, dict[str, list[float]]] = {}
    for point in points:
        record = json_record(point)
        lists = curves.setdefault(record.pop("design"), {name: [] for name in record})
        for name, value in record.items():
            lists[name].append(value)
    return {
        design: {name: values for name, values in lists.items() if not np.isnan(values).all()}
        for design, lists in curves.items()
    }


def _add_margins(report: Report, designs: Mapping[str, Design], gain_factor: float) -> None:
    """Add the margins of designs, side by side."""
    margins = {name: _margins(design, gain_factor) for name, design in designs.items()}
    physical = all(design.hardware is not None for design in designs.values())
    units = json_units(LoopMargins) | ({"gamma": "nm", "rms": "nm"} if physical else {})
    report.data |= {"designs": margins, "units": units, "gain_factor": gain_factor}
    unit, factor = shown_unit(units.get("gamma", ""))
    norms = [factor * record["gamma"] if "gamma" in record else None for record in margins.values()]
    quantities = [("stable", "stable", "")]
    quantities += [(c.heading, c.key, c.shown_unit) for c in columns(LoopMargins) if c.heading]
    report.add_table(
        f"Margins at {gain_factor:g} times the sensor gain that each design assumes",
        ("quantity", *margins, "unit"),
        [("norm", *norms, unit)]
        + [
            (heading, *(record.get(key) for record in margins.values()), unit)
            for heading, key, unit in quantities
        ],
    )


def _margins(design: Design, gain_factor: float) -> dict[str, Any]:
    """Return the method of a design, its norm in its model, and the margins of its loop."""
    record: dict[str, Any] = {"method": design.method}
    if design.is_estimator:
        record |= {"gamma": design.gamma, "rms": design.rms}
    if design.hardware is not None:
        loop = close_loop(design.hardware, design.controller, sensor_gain=gain_factor)
        record["stable"] = loop.is_stable
        if loop.is_stable:
            record |= json_record(loop_margins(loop))
    return record


def _points(kind: _Kind, design: str, *series: FloatArray) -> list[Facts]:
    """Return rows of a kind, of which the series are the numbers in the order of its columns."""
    columns = tuple(replace(how, name=name) for name, how in (("design", Column()), *kind))
    names = [name for name, _ in kind]
    return [
        Facts(columns, {"design": design, **dict(zip(names, map(float, numbers), strict=True))})
        for numbers in zip(*series, strict=True)
    ]


def _loop_points(designs: Mapping[str, Design], gain_factor: float) -> list[Facts]:
    """Return the points of the loops of designs."""
    return [
        point
        for name, _, _, broken in open_loops(closed_loops(designs, gain_factor))
        if broken is not None
        for *curves, response in [loop_points(broken)]
        for point in _points(_LOOP, name, *curves, response.real, response.imag)
    ]


def _sigma_points(designs: Mapping[str, Design], gain_factor: float) -> list[Facts]:
    """Return the points of the curves of designs."""
    loops = closed_loops(designs, gain_factor, needed=False)
    return [
        point
        for name, (f, *parts) in sigma_curves(designs, loops).items()
        for point in _points(
            _SIGMA, name, f, *(np.full(f.size, np.nan) if p is None else p for p in parts)
        )
    ]


def _named_steps(
    designs: Mapping[str, Design], gain_factor: float, frames: int = SHOWN_FRAMES
) -> list[tuple[str, LoopStep]]:
    """Return the step responses of designs, named with their axes where these differ."""
    return [
        (axes_name(name, [step.axis], alone=len(steps) == 1), step)
        for name, steps in design_steps(closed_loops(designs, gain_factor), frames=frames).items()
        for step in steps
    ]


def _add_step_facts(report: Report, designs: Mapping[str, Design], gain_factor: float) -> None:
    """Add how the loops follow a step."""
    percent = {"unit": "%", "format": ".1f"}
    ms = {"unit": "ms", "scale": 1e3, "format": ".2f"}
    rows = [
        facts(
            design=fact(name, "design"),
            overshoot_percent=fact(step.overshoot_percent, "overshoot", **percent),
            settling_s=fact(step.settling_s, "settling time, to 5 %", **ms),
        )
        for name, step in _named_steps(designs, gain_factor, frames=_SETTLING_FRAMES)
    ]
    report.add_rows("steps", "After a step of the wavefront", rows)


def _step_points(designs: Mapping[str, Design], gain_factor: float) -> list[Facts]:
    """Return the points of the step responses."""
    return [
        point
        for name, step in _named_steps(designs, gain_factor)
        for point in _points(_STEP, name, step.time_s, step.residual, step.command)
    ]


_Kind: TypeAlias = Sequence[tuple[str, Column]]
_Points: TypeAlias = Callable[[Mapping[str, Design], float], list[Facts]]
_POINTS: Mapping[str, _Points] = {  # of the curves, but for those of broken loops
    "sigma": _sigma_points,
    "step": _step_points,
}
