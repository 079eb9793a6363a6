"""The commands design, show and verify: gain files, what they hold, and their certificates."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import add_truth, choose_design_unit, load_shown
from lbt_synth.cli.output import Report
from lbt_synth.config.load import config_from_text
from lbt_synth.design import Design
from lbt_synth.design.result import without_units
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import load_with_digest, read_design, require_gain_name
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.registry import design_title, option_names
from lbt_synth.methods.request import Wording, design_request
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import LoopFacts
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.rows import fact_table, json_record

_WORDING = Wording(method="--method {}", option="--{}")


def run(arguments: Namespace) -> Report:
    """Design a controller and write its gain file."""
    given = given_options(arguments, *option_names())
    request = design_request(arguments.method, given, _WORDING)
    require_writable(require_gain_name(arguments.output), inputs=[arguments.config])
    config = load_shown(arguments)
    design = config.design(request)
    path = save_gain(arguments.output, design)
    report = describe_design(design)
    alike = () if given else (request.method.name,)
    add_truth(report, design, config, without=alike)
    if design.method != request.method.name:
        title = design_title(design.method)
        report.notes.append(
            f"note: the bound leaves no better choice than the {title}, which is it."
        )
    report.note_written(path)
    return report


_SMALL_MODULUS = 0.3


def describe_design(design: Design, *, matrices: bool = False) -> Report:
    """Describe a design: what it is, its loop, its certificate, and its matrices if asked for."""
    report = Report(
        data={
            "solver": asdict(design.solver),
            "poles": [complex(p) for p in design.poles],
            "controller_spectral_radius": design.controller.to_statespace().spectral_radius,
        }
    )
    facts: list[Any] = [design.facts()]
    margins = []
    if design.hardware is not None:
        facts.append(_loop_facts(report, design.hardware))
        if not design.other_sensors:
            margins = [loop_margins(close_loop(design.hardware, design))]
            report.data["margins"] = json_record(*margins)
            report.opening += [each.survival for each in margins]
        report.notes += _loop_notes(design, design.hardware, report.data)
        report.notes += [f"warning: {text}" for each in margins for text in each.fragilities]
    report.add_records(*facts)
    printed = fact_table("Design", *facts, *margins)
    report.tables.append(without_units(printed) if design.hardware is None else printed)
    tables = design.tables()
    report.notes += [*design.notes(), *(note for table in tables for note in table.notes)]
    report.notes += [f"assumes: {assumption}." for assumption in design.assumptions]
    report.data["assumptions"] = design.assumptions
    for table in tables:
        report.add_rows(table.key, table.title, table.rows)
    report.add_rows("checks", "Certificate", design.certificate.checks)
    if matrices:
        named = {name: getattr(design.controller, name) for name in "ABCD"}
        named |= design.arrays()
        report.data["matrices"] = named
        with np.printoptions(precision=8, linewidth=160, suppress=False):
            for name, value in named.items():
                report.notes += [f"{name} =", *str(value).splitlines()]
    return report


def add_moving_gain(report: Report, design: Design) -> None:
    """Add the intervals of a sensor gain that moves, for a design with a stable loop."""
    from lbt_synth.loop import moving_gain

    if design.hardware is None or design.other_sensors:
        return
    loop = close_loop(design.hardware, design)
    if loop.is_stable:
        report.add_facts("Sensor gain that moves", moving_gain(loop), key="moving_gain")


def _loop_facts(report: Report, hardware: LoopHardware) -> LoopFacts:
    """Return the facts of a loop; the data get its mirror, if that has dynamics."""
    facts = hardware.facts()
    if hardware.mirror is not None:
        settling_s = hardware.mirror.step_response().settling_s
        report.data["mirror"] = asdict(hardware.mirror) | {"settling_s": settling_s}
    return facts


def _loop_notes(design: Design, hardware: LoopHardware, data: dict[str, Any]) -> list[str]:
    notes = []
    alone = data["controller_spectral_radius"]
    if hardware.mirror is not None and not design.knows_mirror:
        notes.append(
            "note: this filter commands its estimate as if the mirror settled at once, so that its "
            "estimation error is not the residual; --method lqg commands for the mirror's dynamics."
        )
    if "margins" in data and (modulus := data["margins"]["modulus"]) < _SMALL_MODULUS:
        notes.append(
            f"note: the modulus margin {modulus:.3g} is small; a loop is usually asked for "
            f"{_SMALL_MODULUS:g} or more. Lower the gain, or design with more noise."
        )
    if alone > 1:
        notes.append(
            f"note: the controller alone has a pole of modulus {alone:.4g}; with the loop open its "
            "commands grow. Reset it whenever the loop opens."
        )
    return notes


def run_show(arguments: Namespace) -> Report:
    """Describe the design in a gain file, what a frame costs, and its matrices if asked for."""
    design, digest = load_with_digest(arguments.gain)
    choose_design_unit(arguments, design)
    report = describe_design(design, matrices=arguments.matrices)
    add_moving_gain(report, design)
    report.data |= {"file": arguments.gain, "digest": digest}
    unproved = ["route and status of the solver"]
    unproved += ["what its record shows"] * (design.method == "predictor")
    unproved += ["assumptions"] * bool(design.assumptions)
    unproved += ["configuration, and so the truth"] * bool(design.configuration)
    report.data["not_proved"] = unproved
    report.notes += [
        f"proved: the certificate, computed again from this file of digest {digest}.",
        f"not proved, the file's word: {'; '.join(unproved)}.",
    ]
    if not design.other_sensors:
        from lbt_synth.interop import frame_cost  # which a design does not need

        cost = frame_cost(design)
        report.data["frame_cost"] = json_record(cost)
        report.tables.append(fact_table("Cost per frame, as exported to C", cost))
    if design.configuration:
        add_truth(report, design, config_from_text(design.configuration, Path(arguments.gain)))
    return report


def run_verify(arguments: Namespace) -> Report:
    """Recompute the certificate of a gain file."""
    design, digest = read_design(arguments.gain)
    certificate = design.certificate
    report = Report(
        data={
            "file": arguments.gain,
            "digest": digest,
            "method": design.method,
            "passed": certificate.passed,
        },
        notes=[
            f"{arguments.gain}: {'verified' if certificate.passed else 'NOT VERIFIED'}",
            f"digest {digest}",
        ],
        passed=certificate.passed,
    )
    report.add_rows("checks", "Certificate", certificate.checks)
    add_moving_gain(report, design)
    return report
