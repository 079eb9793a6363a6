"""The commands show and verify: what is in a gain file, and its certificate computed again."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.design import add_moving_gain, describe_design
from lbt_synth.cli.loop_inputs import add_truth, choose_design_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.config.load import config_from_text
from lbt_synth.files.gain_file.store import load_with_digest, read_design
from lbt_synth.interop import frame_cost
from lbt_synth.storage.rows import fact_table, json_record


def run(arguments: Namespace) -> Report:
    """Describe the design in a gain file, what a frame costs, and its matrices if asked for."""
    design, digest = load_with_digest(arguments.gain)
    choose_design_unit(arguments, design)
    report = describe_design(design, matrices=arguments.matrices)
    add_moving_gain(report, design)
    report.data |= {"file": arguments.gain, "digest": digest}
    unproved = ["route and status of the solver"]
    unproved += ["assumptions"] * bool(design.assumptions)
    unproved += ["configuration, and so the truth"] * bool(design.configuration)
    report.data["not_proved"] = unproved
    report.notes += [
        f"proved: the certificate, computed again from this file of digest {digest}.",
        f"not proved, the file's word: {'; '.join(unproved)}.",
    ]
    if not design.other_sensors:
        cost = frame_cost(design)
        report.data["frame_cost"] = json_record(cost)
        report.tables.append(fact_table("Cost per frame, as exported to C", cost))
    if design.configuration:
        with show_spinner("comparing in the truth", quiet=arguments.json):
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
