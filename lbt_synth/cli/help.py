"""The command help: what a command does, and its arguments."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli.output import Report
from lbt_synth.cli.parser import command_help


def run(arguments: Namespace) -> Report:
    """Show the help of a command, or of all."""
    text = command_help(arguments.topic or "")
    return Report(data={"help": text}, opening=text.splitlines())
