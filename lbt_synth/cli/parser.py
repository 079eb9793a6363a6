"""The parser of the command line: every command, its help and its arguments."""

from __future__ import annotations

import argparse
from typing import NoReturn

import lbt_synth
from lbt_synth.cli import arguments
from lbt_synth.cli.streams import printable

# In the order of the help, each with the function that adds its arguments, whose docstring is its
# help. A command runs in the module of its name, with underscores for dashes.
COMMANDS = {
    add_arguments.__name__.replace("_", "-"): add_arguments
    for add_arguments in (
        *(arguments.init, arguments.schema),
        *(arguments.design, arguments.show, arguments.verify, arguments.export, arguments.sigma),
        *(arguments.simulate, arguments.telemetry, arguments.identify, arguments.auto),
        *(arguments.diagnose, arguments.league),
        *(arguments.robustness, arguments.tradeoff, arguments.limits, arguments.report),
        *(arguments.end_to_end, arguments.end_to_end_table),
        *(arguments.mirror, arguments.modal, arguments.study, arguments.paper),
    )
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors show what was typed without the control characters in it."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and what is wrong with the words, and exit with status 2."""
        super().error(printable(message))


def build_parser(*named: str) -> argparse.ArgumentParser:
    """Build the parser of all commands, with the arguments of those that are named."""
    parser = Parser(
        prog="lbt-synth",
        description="Design, certify and analyse tip/tilt controllers that reject vibrations.",
        epilog="Exit status: 0 done, 1 a design or verification failed, 2 wrong usage or input.",
    )
    parser.add_argument("--version", action="version", version=f"lbt-synth {lbt_synth.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, add_arguments in COMMANDS.items():
        text = add_arguments.__doc__ or ""
        command = commands.add_parser(
            name, help=text.splitlines()[0].rstrip("."), description=" ".join(text.split())
        )
        arguments.add_switch(command, "--json", "print one JSON object instead")
        if name in named:
            add_arguments(command)
    return parser


def whole_parser() -> argparse.ArgumentParser:
    """Build the parser with the arguments of every command, from which shells complete words."""
    return build_parser(*COMMANDS)
