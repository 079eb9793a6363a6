"""The commands help and completion: what commands do, for people and for shells."""

from __future__ import annotations

from argparse import Action, ArgumentParser, Namespace
from collections.abc import Iterator

from lbt_synth.cli.output import Report
from lbt_synth.cli.parser import COMMANDS, build_parser, command_help


def run(arguments: Namespace) -> Report:
    """Show the help of a command, or of all."""
    text = command_help(arguments.topic or "")
    return Report(data={"help": text}, opening=text.splitlines())


def run_completion(arguments: Namespace) -> Report:
    """Print the script of a shell, made from the arguments of all commands."""
    import shtab  # not needed to build the parser of another command

    parser = build_parser(*COMMANDS)
    for action in _takes_files(parser):
        if action.dest == "topic":  # of help
            action.choices = list(COMMANDS)
        else:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    text = shtab.complete(parser, shell=arguments.shell)
    return Report(data={"shell": arguments.shell, "script": text}, opening=text.splitlines())


def _takes_files(parser: ArgumentParser) -> Iterator[Action]:
    """Yield the arguments of all commands that may be the name of a file."""
    for action in parser._actions:
        if isinstance(action.choices, dict):
            for command in action.choices.values():
                yield from _takes_files(command)
        elif action.choices is None and action.nargs != 0 and action.type in (None, str):
            yield action
