"""The table of commands."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable

from lbt_synth.cli.design_commands import design, show, verify
from lbt_synth.cli.front_command import tradeoff_command
from lbt_synth.cli.limits_command import limits
from lbt_synth.cli.loop_commands import sigma, simulate
from lbt_synth.cli.modal_command import modal
from lbt_synth.cli.output import Report
from lbt_synth.cli.paper_command import paper
from lbt_synth.cli.robustness_command import robustness

COMMANDS: dict[str, Callable[[Namespace], Report]] = {
    "design": design,
    "limits": limits,
    "modal": modal,
    "paper": paper,
    "robustness": robustness,
    "show": show,
    "sigma": sigma,
    "simulate": simulate,
    "tradeoff": tradeoff_command,
    "verify": verify,
}
