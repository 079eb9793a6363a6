"""The command verify: the certificate of a gain file, recomputed."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.design_description import add_moving_gain
from lbt_synth.cli.output import Report
from lbt_synth.files.gain_file.store import read_design


def run(arguments: Namespace) -> Report:
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
