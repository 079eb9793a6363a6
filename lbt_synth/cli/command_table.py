"""The table of commands."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable

from lbt_synth.cli.design import design, show, verify
from lbt_synth.cli.end_to_end import end_to_end, end_to_end_table
from lbt_synth.cli.export import export
from lbt_synth.cli.identify import auto, identify_command
from lbt_synth.cli.limits import limits
from lbt_synth.cli.mirror import mirror
from lbt_synth.cli.modal import modal
from lbt_synth.cli.output import Report
from lbt_synth.cli.paper import paper
from lbt_synth.cli.report import report_command
from lbt_synth.cli.robustness import robustness
from lbt_synth.cli.simulate import sigma, simulate
from lbt_synth.cli.study import study
from lbt_synth.cli.telemetry import telemetry
from lbt_synth.cli.tradeoff import tradeoff_command

COMMANDS: dict[str, Callable[[Namespace], Report]] = {
    "auto": auto,
    "design": design,
    "e2e": end_to_end,
    "e2e-table": end_to_end_table,
    "export": export,
    "identify": identify_command,
    "limits": limits,
    "mirror": mirror,
    "modal": modal,
    "paper": paper,
    "report": report_command,
    "robustness": robustness,
    "show": show,
    "sigma": sigma,
    "simulate": simulate,
    "study": study,
    "telemetry": telemetry,
    "tradeoff": tradeoff_command,
    "verify": verify,
}
