"""The command design: a controller from a configuration, as a gain file, and what it prints."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from typing import Any

import numpy as np

from lbt_synth.cli.argument_kinds import given_options
from lbt_synth.cli.display import load_shown
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.cli.truth_table import add_truth
from lbt_synth.design import Design
from lbt_synth.design.result import without_units
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.loop import LoopMargins, close_loop, loop_margins
from lbt_synth.loop.loop_errors import FRAGILE_DB, FRAGILE_FRAMES
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
    with show_spinner(f"designing ({request.method.name})", quiet=arguments.json):
        design = config.design(request)
    path = save_gain(arguments.output, design)
    report = describe_design(design)
    with show_spinner("comparing in the truth", quiet=arguments.json):
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
            report.opening.append(_survival(*margins))
        report.notes += _loop_notes(design, design.hardware, report.data)
        report.notes += [note for each in margins for note in _fragile_notes(each, design.hardware)]
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


def _survival(margins: LoopMargins) -> str:
    """Say which errors of the loop a design survives, each alone and together."""

    def size(value: float, unit: str) -> str:
        return f"{value:.2g} {unit}".strip() if np.isfinite(value) else "any"

    low_db, high_db = _gain_errors_db(margins)
    alone = (
        f"survives {size(margins.delay_frames, 'frames')} more delay or "
        f"{size(margins.early_frames, 'frames')} less, {size(high_db, 'dB')} more sensor gain or "
        f"{size(low_db, 'dB')} less"
    )
    if np.isnan(margins.together):
        return f"{alone}; at once is not known for a mirror with dynamics."
    frames, decibels = margins.together * FRAGILE_FRAMES, margins.together * FRAGILE_DB
    return f"{alone}; at once {frames:.2g} frames and {decibels:.2g} dB either way (proved)."


def _gain_errors_db(margins: LoopMargins) -> tuple[float, float]:
    """Return how much less and how much more sensor gain a loop survives [dB]; inf for any."""
    with np.errstate(divide="ignore"):  # no gain is too low
        low_db, high_db = 20 * np.abs(np.log10([margins.gain_low, margins.gain_high]))
    return float(low_db), float(high_db)


def _fragile_notes(margins: LoopMargins, hardware: LoopHardware) -> list[str]:
    """Warn of a delay or a gain that is hardly off and makes the loop unstable."""
    notes, frame_us = [], 1e6 * hardware.dt_s
    for frames, word in ((margins.delay_frames, "more"), (margins.early_frames, "less")):
        if frames < FRAGILE_FRAMES:
            notes.append(
                f"warning: {frames:.2g} frames ({frames * frame_us:.2g} us) {word} delay make this "
                "loop unstable. Do not close it so: take another method, or robust with "
                "delay_error_frames."
            )
    if (least := min(_gain_errors_db(margins))) < FRAGILE_DB:
        notes.append(
            f"warning: a sensor gain that is off by {least:.2g} dB makes this loop unstable."
        )
    if not notes and margins.together < 1:
        notes.append(
            f"warning: {FRAGILE_FRAMES:g} frames of delay and {FRAGILE_DB:g} dB of sensor gain at "
            "once are more than this loop is proved to survive. robust demands both together."
        )
    return notes


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
