"""The table of commands."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable

from lbt_synth.cli.design_commands import design, show, verify
from lbt_synth.cli.end_to_end_commands import end_to_end, end_to_end_table
from lbt_synth.cli.export_command import export
from lbt_synth.cli.front_command import tradeoff_command
from lbt_synth.cli.identify_command import auto, identify_command
from lbt_synth.cli.limits_command import limits
from lbt_synth.cli.loop_commands import sigma, simulate
from lbt_synth.cli.mirror_command import mirror
from lbt_synth.cli.modal_command import modal
from lbt_synth.cli.output import Report
from lbt_synth.cli.paper_command import paper
from lbt_synth.cli.robustness_command import robustness
from lbt_synth.cli.study_command import study
from lbt_synth.cli.telemetry_command import telemetry

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
    "robustness": robustness,
    "show": show,
    "sigma": sigma,
    "simulate": simulate,
    "study": study,
    "telemetry": telemetry,
    "tradeoff": tradeoff_command,
    "verify": verify,
}
