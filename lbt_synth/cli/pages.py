"""The commands plot, report and explore: views of loops, and pages about designs."""

from __future__ import annotations

import re
import sys
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from lbt_synth.cli.arguments import input_files
from lbt_synth.cli.loop_inputs import (
    choose_design_unit,
    difference_notes,
    load_designs,
    load_shown,
    margin_columns,
)
from lbt_synth.cli.output import Report
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.loop.margins import LoopMargins
from lbt_synth.report.designs import WORDS, design_facts, design_report, report_page, verdict
from lbt_synth.report.draw import figure_series
from lbt_synth.report.figures import loop_figure
from lbt_synth.report.figures.loops import axes_name, closed_loops, design_steps
from lbt_synth.report.page.html import require_page_names, write_page
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import own_display_unit
from lbt_synth.storage.rows import fact, facts, json_record, json_units, row_table
from lbt_synth.storage.words import rank_names, unstable_text
from lbt_synth.validation import integer

# what JSON has as a key, among the margins, or as numbers in place of words
_WITHOUT = ("design", "modulus", "phase_deg", "delay_frames", "crossover_hz", *WORDS)
_LOCAL = ("localhost", "127.0.0.1", "::1")
_SETTLING_FRAMES = 8000  # within which loops settle, beyond what is drawn


def run_plot(arguments: Namespace) -> Report:
    """Print the margins of designs, and write their figure and its points."""
    view, gain = arguments.kind, arguments.gain_factor
    designs = load_designs(arguments.gains)
    choose_design_unit(arguments, dict(zip(arguments.gains, designs.values(), strict=True)))
    report = Report(figure=lambda: loop_figure(designs, view, sensor_gain=gain))
    _add_margins(report, designs, gain)
    with own_display_unit():  # JSON and CSV stay in nm
        curves = list(figure_series(loop_figure(designs, view, sensor_gain=gain)))
    if all(record["stable"] is False for record in report.data["designs"].values()):
        raise UnstableLoopError(
            f"no loop is stable at {gain:g} times the sensor gain that its design assumes, and "
            "there is nothing to draw; lbt-synth show prints the factors that are stable."
        )
    if view == "step":
        _add_step_facts(report, designs, gain)
        report.tables.reverse()
    report.rows = [
        facts(
            panel=fact(c.panel), curve=fact(c.name), heading=fact(c.heading), x=fact(x), y=fact(y)
        )
        for c in curves
        for x, y in zip(c.x, c.y.tolist(), strict=True)
    ]
    report.data["curves"] = [asdict(curve) for curve in curves]
    return report


def _add_margins(report: Report, designs: Mapping[str, Design], gain_factor: float) -> None:
    lines, margins_of = [], dict[str, LoopMargins]()
    report.data |= {"gain_factor": gain_factor, "designs": {}}
    for name, design in designs.items():
        margins = stable = None
        if design.hardware is not None:
            loop = close_loop(design.hardware, design.controller, sensor_gain=gain_factor)
            stable, margins = loop.is_stable, loop_margins(loop) if loop.is_stable else None
        if margins is not None:
            margins_of[name] = margins
        record = {} if margins is None else json_record(margins)
        report.data["designs"][name] = {"method": design.method, "stable": stable} | record
        lines.append(
            facts(
                design=fact(name, "design"),
                stable=fact(stable, "stable"),
                **margin_columns(margins),
            )
        )
    records = report.data["designs"].items()
    if unstable := [name for name, record in records if record["stable"] is False]:
        report.verdict.append(f"{unstable_text(unstable)} at this sensor gain.")
    falling = {name: -margins.modulus for name, margins in margins_of.items()}
    words = rank_names(falling, ", with the largest margin,", ", with the least margin,")
    report.verdict += [f"{name}{said} {margins_of[name].survival}" for name, said in words.items()]
    report.data["units"] = report.data.get("units", {}) | json_units(LoopMargins)
    caption = f"Margins at {gain_factor:g} times the sensor gain that each design assumes"
    report.tables.append(row_table(caption, lines))


def _add_step_facts(report: Report, designs: Mapping[str, Design], gain_factor: float) -> None:
    steps = design_steps(closed_loops(designs, gain_factor), frames=_SETTLING_FRAMES)
    percent = {"unit": "%", "format": ".1f"}
    ms = {"unit": "ms", "scale": 1e3, "format": ".2f"}
    rows = [
        facts(
            design=fact(axes_name(name, [step.axis], alone=len(responses) == 1), "design"),
            overshoot_percent=fact(step.overshoot_percent, "overshoot", **percent),
            settling_s=fact(step.settling_s, "settling time, to 5 %", **ms),
        )
        for name, responses in steps.items()
        for step in responses
    ]
    report.add_rows("steps", "After a step of the wavefront", rows)


def run_report(arguments: Namespace) -> Report:
    """Assess designs in the loop of a configuration, and write the page."""
    require_page_names(arguments.output, arguments.pdf, inputs=input_files(arguments))
    if arguments.title is not None and not arguments.title.strip():
        raise ProblemError("--title must hold at least one letter; got an empty text.")
    config = load_shown(arguments)
    designs = load_designs(arguments.gains, config)
    files = dict(zip(designs, arguments.gains, strict=True))
    assessed = design_report(config, designs)
    page = report_page(assessed, files, arguments.title)
    rows = [design_facts(assessed, one) for one in assessed.assessments]
    limit = assessed.limits.limit
    report = Report(
        data={
            "designs": {
                row.design: json_record(row, without=_WITHOUT)
                | {
                    "checks": [json_record(check) for check in one.checks],
                    "margins": None if one.margins is None else json_record(one.margins),
                    "stable_sensor_gains": one.sensor_gains,
                }
                for row, one in zip(rows, assessed.assessments, strict=True)
            },
            "units": json_units(rows[0]),
            "limit_nm": None if limit is None else limit.rms_nm,
            "sensor_gain": assessed.real_gain,
            "sha256": page.digests,
            "made": page.made,
        },
        verdict=[verdict(assessed)],
        tables=[row_table(f"Designs in the loop of {config.source.name}", rows)],
        notes=difference_notes(config, designs),
    )
    report.note_written(*write_page(page, arguments.output, pdf=arguments.pdf))
    return report


def run_explore(arguments: Namespace) -> Report:
    """Serve the page until it is interrupted."""
    integer(arguments.port, "--port", at_least=0, at_most=65_535)
    for origin in arguments.origin:
        if not re.fullmatch(r"[\w.*-]+:\d{1,5}", origin):
            raise ProblemError(f"--origin must be HOST:PORT, as localhost:8080; got {origin!r}.")
    folder = Path(arguments.output)
    require_writable(folder / "explored-1.yaml")
    config = load_shown(arguments)
    designs = load_designs(arguments.gains)

    from lbt_synth.report.explore import serve  # bokeh's server, slow to import

    report = Report()
    said = [f"note: whoever reaches this address can use the page and write into {folder}."]
    said = said * (arguments.host not in _LOCAL)

    def announce(url: str) -> None:
        report.data["url"] = url
        stream = sys.stderr if arguments.json else sys.stdout
        print(f"Open {url} in a browser. Ctrl-C ends.", *said, sep="\n", file=stream, flush=True)

    place = {"host": arguments.host, "port": arguments.port, "origins": arguments.origin}
    report.note_written(*serve(config, designs, folder, **place, announce=announce))
    return report
