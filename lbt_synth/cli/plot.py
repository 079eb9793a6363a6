"""The command plot: margins of loops, and sigma, bode, nyquist, nichols or step curves."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.cli.loop_inputs import choose_design_unit, load_designs, margin_columns
from lbt_synth.cli.output import Report
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
from lbt_synth.storage.rows import Column, Facts, fact, facts, json_record, json_units, row_table
from lbt_synth.validation import FloatArray

_SETTLING_FRAMES = 8000  # within which loops settle, beyond what is drawn

_UNITS = {"frequency_hz": "Hz", "gain_db": "dB", "phase_deg": "deg", "time_s": "s"}
_LOOP = ("frequency_hz", "gain_db", "phase_deg", "real", "imaginary")  # phases without jumps
_SIGMA = ("frequency_hz", "error", "rejection", "noise_transfer")  # of phase and noise to residual
# series of numbers of a design, or of its loop broken at one measurement, by their names
_Curves: TypeAlias = dict[str, dict[str, FloatArray]]


def run(arguments: Namespace) -> Report:
    """Print the margins of designs, and write their figure and their points."""
    view, gain = arguments.kind, arguments.gain_factor
    designs = load_designs(arguments.gains)
    choose_design_unit(arguments, dict(zip(arguments.gains, designs.values(), strict=True)))
    report = Report(figure=lambda: loop_figure(designs, view, sensor_gain=gain))
    if view == "step":
        _add_step_facts(report, designs, gain)
    _add_margins(report, designs, gain)
    curves = _draw(view, designs, gain)
    if not curves:
        raise UnstableLoopError(
            f"no loop is stable at {gain:g} times the sensor gain that its design assumes, and "
            "there is nothing to draw; lbt-synth show prints the factors that are stable."
        )
    report.rows = list(_points(curves))
    report.data["curves"] = {
        name: {key: values for key, values in series.items() if not np.isnan(values).all()}
        for name, series in curves.items()
    }
    report.data["units"] |= {name: _UNITS[name] for name in report.rows[0].values if name in _UNITS}
    return report


def _draw(view: str, designs: Mapping[str, Design], gain_factor: float) -> _Curves:
    """Return the curves of designs in a view; nan stands for what a design does not have."""
    if view == "step":
        return {
            name: {"time_s": step.time_s, "residual": step.residual, "command": step.command}
            for name, step in _named_steps(designs, gain_factor)
        }
    if view == "sigma":
        loops = closed_loops(designs, gain_factor, needed=False)
        return {
            name: {
                key: np.full(f.size, np.nan) if values is None else values
                for key, values in zip(_SIGMA, (f, *parts), strict=True)
            }
            for name, (f, *parts) in sigma_curves(designs, loops).items()
        }
    curves: _Curves = {}
    for name, _, _, broken in open_loops(closed_loops(designs, gain_factor)):
        if broken is not None:
            *series, response = loop_points(broken)
            curves[name] = dict(zip(_LOOP, (*series, response.real, response.imag), strict=True))
    return curves


def _points(curves: _Curves) -> Iterator[Facts]:
    """Yield a row for each point of the curves."""
    columns = tuple(Column(name=name) for name in ("design", *next(iter(curves.values()))))
    for name, series in curves.items():
        for numbers in zip(*(values.tolist() for values in series.values()), strict=True):
            yield Facts(columns, {"design": name, **dict(zip(series, numbers, strict=True))})


def _add_margins(report: Report, designs: Mapping[str, Design], gain_factor: float) -> None:
    """Add the margins of designs, a line for each."""
    records: dict[str, dict[str, Any]] = {}
    lines = []
    for name, design in designs.items():
        records[name], margins = {"method": design.method}, None
        if design.is_estimator:
            records[name] |= {"gamma": design.gamma, "rms": design.rms}
        if design.hardware is not None:
            loop = close_loop(design.hardware, design.controller, sensor_gain=gain_factor)
            records[name]["stable"] = loop.is_stable
            if loop.is_stable:
                margins = loop_margins(loop)
                records[name] |= json_record(margins)
                report.verdict.append(f"{name} {margins.survival}")
            else:
                report.verdict.insert(0, f"{name} is unstable at this sensor gain.")
        crossover = getattr(margins, "crossover_hz", None)
        lines.append(
            facts(
                design=fact(name, "design"),
                stable=fact(records[name].get("stable"), "stable"),
                **margin_columns(margins),
                phase=fact(getattr(margins, "phase_deg", None), "phase", unit="deg", format=".1f"),
                crossover=fact(crossover, "crossover", unit="Hz", format=".1f"),
            )
        )
    physical = all(design.hardware is not None for design in designs.values())
    units = json_units(LoopMargins) | ({"gamma": "nm", "rms": "nm"} if physical else {})
    report.data |= {"designs": records, "gain_factor": gain_factor}
    report.data["units"] = report.data.get("units", {}) | units
    caption = f"Margins at {gain_factor:g} times the sensor gain that each design assumes"
    report.tables.append(row_table(caption, lines))


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
