"""The commands design, show and verify: gain files, what they hold, and their certificates."""

from __future__ import annotations

from argparse import Namespace
from contextlib import suppress
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

from lbt_synth.cli.arguments import given_options, input_files
from lbt_synth.cli.loop_inputs import (
    add_certificate,
    add_truth,
    choose_design_unit,
    keep_unit,
    load_shown,
    say_accelerometers,
)
from lbt_synth.cli.output import Report
from lbt_synth.config.load import config_from_text
from lbt_synth.design import Design
from lbt_synth.design.certificate import say_checks
from lbt_synth.design.result import without_units
from lbt_synth.errors import NumericalError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import load_with_digest, read_design, require_gain_name
from lbt_synth.linear import estimator_form
from lbt_synth.loop import close_loop, loop_margins
from lbt_synth.methods.registry import design_title, option_names
from lbt_synth.methods.request import design_request
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, fact, fact_table, facts, json_record, row_table


def run_design(arguments: Namespace) -> Report:
    """Design a controller and write its gain file."""
    options = given_options(arguments, *option_names())
    request = design_request(arguments.method, options)
    require_writable(require_gain_name(arguments.output), inputs=input_files(arguments))
    config = load_shown(arguments)
    design = config.design(request)
    path = save_gain(arguments.output, keep_unit(design, config.imaging.diameter_m))
    report = Report()
    add_truth(report, design, config, without=() if options else (request.method.name,))
    describe_design(report, design)
    if design.method != request.method.name:
        title = design_title(design.method)
        report.notes.append(
            f"note: the bound leaves no better choice than the {title}, which is it."
        )
    report.note_written(path)
    return report


def describe_design(report: Report, design: Design) -> None:
    """Add what a design is, what its loop survives, and its certificate."""
    alone = design.controller.to_statespace().spectral_radius
    report.data |= {
        "solver": asdict(design.solver),
        "poles": [complex(p) for p in design.poles],
        "controller_spectral_radius": alone,
    }
    records: list[Any] = [design.facts()]
    margins = []
    if design.hardware is not None:
        records.append(design.hardware.facts())
        if design.hardware.mirror is not None:
            settling_s = design.hardware.mirror.step_response().settling_s
            report.data["mirror"] = asdict(design.hardware.mirror) | {"settling_s": settling_s}
        if not design.other_sensors:
            margins = [loop_margins(close_loop(design.hardware, design))]
            report.data["margins"] = json_record(*margins)
    fragile = [f"{text[0].upper()}{text[1:]}" for one in margins for text in one.fragilities]
    report.verdict = [*fragile, *(report.verdict or [_say_model(design, records[0])])]
    report.verdict += [f"It {one.survival}" for one in margins if not one.fragilities]
    add_certificate(report, design)
    report.add_records(*records)
    printed = fact_table("Design", *records, *margins)
    report.tables.append(without_units(printed) if design.hardware is None else printed)
    report.notes += _loop_notes(design, alone)
    report.notes += design.notes()
    report.add_rows("checks", "Certificate", design.certificate.checks)


def _say_model(design: Design, facts: Facts) -> str:
    """Return what a design promises in its own model, for one without a truth."""
    title = f"The {design_title(design.method)}"
    if design.plant is None and (bought := say_accelerometers(design)):
        return f"{title} leaves {bought}, on unseen frames of its record."
    residual_nm = facts.values.get("residual_nm", design.expected_residual_nm)
    if residual_nm is not None and isfinite(residual_nm):
        place = "on unseen frames of its record" if design.plant is None else "in its model"
        return f"{title} leaves {nm_text(residual_nm, '.1f')} rms {place}."
    if design.is_estimator:
        return f"{title} leaves an estimation error of {design.rms:.6g} rms in its model."
    return f"{title} has {design.controller.n_states} states."


def add_moving_gains(report: Report, design: Design) -> None:
    """Add what is proved of a moving gain and of clipping, for a design with a stable loop."""
    from lbt_synth.loop.stable_range import moving_gain, stroke_ratio

    if design.hardware is None or design.other_sensors:
        return
    loop = close_loop(design.hardware, design)
    if loop.is_stable:
        report.add_facts("Sensor gain that moves", moving_gain(loop), key="moving_gain")
        plain, estimator = stroke_ratio(design.hardware, design), None
        with suppress(NumericalError):  # not every controller has that form
            estimator = stroke_ratio(design.hardware, estimator_form(design))
        clipped = facts(
            plain=fact(plain, "proved in the plain form, up to", unit="strokes"),
            estimator=fact(estimator, "  in the estimator form, up to", unit="strokes"),
        )
        caption = "Commands that are clipped; at most 10000 strokes are sought"
        report.add_facts(caption, clipped, key="clipped_commands")
        report.verdict.append(
            f"Its commands may ask for {plain:.3g} strokes in the plain form (proved)."
        )


def _loop_notes(design: Design, alone: float) -> list[str]:
    if design.hardware is None:
        return []
    notes = list[str]()
    if design.hardware.mirror is not None and not design.knows_mirror:
        notes.append(
            "note: this filter commands its estimate as if the mirror settled at once, so that its "
            "estimation error is not the residual; --method lqg commands for the mirror's dynamics."
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
    choose_design_unit(arguments, {arguments.gain: design})
    report = Report()
    if design.configuration:
        add_truth(report, design, config_from_text(design.configuration, Path(arguments.gain)))
    describe_design(report, design)
    for table in design.tables():
        report.add_rows(table.key, table.title, table.rows)
        report.notes += table.notes
    add_moving_gains(report, design)
    report.data |= {"file": arguments.gain, "digest": digest}
    report.notes += [
        f"proved: the certificate, computed again from this file of digest {digest}.",
        "not proved, the file's word: the solver's route and status, what a record shows, "
        "assumptions, the configuration, and the telescope's diameter.",
    ]
    if not design.other_sensors:
        from lbt_synth.interop.c.export import frame_cost  # which a design does not need

        report.add_facts("Cost per frame, as exported to C", frame_cost(design), key="frame_cost")
    arrays = {name: getattr(design.controller, name) for name in "ABCD"} | design.arrays()
    report.data["matrices"] = arrays
    return report


def run_verify(arguments: Namespace) -> Report:
    """Recompute the certificate of a gain file."""
    design, digest = read_design(arguments.gain)
    passed = design.certificate.passed
    checks = sorted(design.certificate.checks, key=lambda check: check.passed)
    report = Report(
        data={"file": arguments.gain, "digest": digest, "method": design.method, "passed": passed},
        verdict=[
            f"{arguments.gain}: {'verified' if passed else 'NOT VERIFIED'}. {say_checks(checks)}"
        ],
        notes=[f"note: digest {digest}"],
        passed=passed,
    )
    report.add_rows("checks", "Certificate", checks, hidden=("computed_by",))
    report.tables.append(row_table("Certificate, and how it was computed", checks))
    return report
