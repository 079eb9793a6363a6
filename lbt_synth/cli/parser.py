"""The command completion, and the parser of all commands, which it is made from."""

from __future__ import annotations

import argparse
from argparse import Action, ArgumentParser, Namespace
from collections.abc import Iterator
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NoReturn, cast

import lbt_synth
from lbt_synth.cli import arguments
from lbt_synth.cli.streams import printable
from lbt_synth.errors import suggest_word

if TYPE_CHECKING:  # slow to import for --help
    from lbt_synth.cli.output import Report

# In the order of the help: groups with a line on each, and the functions that add the arguments of
# their commands, whose docstrings are the help of these.
GROUPS = {
    "start: a configuration to begin with": (arguments.init, arguments.completion),
    "design: from a configuration to a gain file": (arguments.design,),
    "look: what a design does in the loop, and what could be better": (
        *(arguments.plot, arguments.simulate, arguments.report, arguments.explore),
        *(arguments.limits, arguments.robustness, arguments.tradeoff, arguments.study),
        *(arguments.mirror, arguments.modal),
    ),
    "prove: what a gain file holds, and whether it is true": (arguments.show, arguments.verify),
    "records: from what a loop recorded to a model and a design": (
        *(arguments.telemetry, arguments.identify, arguments.auto, arguments.diagnose),
    ),
    "at the telescope: a gain file in another program": (arguments.export, arguments.rehearse),
    "the paper: the tables of Agapito et al. 2008": (
        *(arguments.paper, arguments.end_to_end, arguments.end_to_end_table),
    ),
}
COMMANDS = {
    add_arguments.__name__.replace("_", "-"): add_arguments
    for group in GROUPS.values()
    for add_arguments in group
}
_NAME_WIDTH, _WIDTH = 20, 80  # of the list of commands


_SHARED_MODULES = {
    "completion": "parser",
    "end-to-end-table": "end_to_end",
    **dict.fromkeys(("show", "verify"), "design"),
    **dict.fromkeys(("limits", "mirror", "robustness", "tradeoff"), "comparisons"),
}


def command_module(name: str) -> str:
    """Return the module in which a command runs: that of its name, or one that it shares."""
    return _SHARED_MODULES.get(name, name.replace("-", "_"))


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line: what is wrong, what was meant, and where help is."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the words, without control characters; exit with status 2."""
        strange = message.removeprefix("unrecognized arguments: ")
        if strange != message and (known := _option_strings(self)):
            message += f"; {suggest_word(strange.split()[0].partition('=')[0], known)}"
        self.exit(2, f"{self.prog}: error: {printable(message)} (see {self.prog} --help)\n")

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            hint = suggest_word(str(value), map(str, action.choices))
            raise argparse.ArgumentError(action, f"invalid choice {value!r}; {hint}")


def _option_strings(parser: argparse.ArgumentParser) -> list[str]:
    """Return the options of a parser and of the commands whose arguments it has."""
    own = [word for word in parser._option_string_actions if word.startswith("--")]
    commands = parser._subparsers._group_actions[0].choices if parser._subparsers else None
    inner = commands.values() if isinstance(commands, dict) else ()
    return list(dict.fromkeys([*own, *(word for each in inner for word in _option_strings(each))]))


def build_parser(*named: str) -> argparse.ArgumentParser:
    """Build the parser of all commands, with the arguments of those that are named."""
    parser = Parser(
        prog="lbt-synth",
        description="Design, certify and analyse tip/tilt controllers that reject vibrations.",
        epilog=f"{_list_commands()}\n\nExit status: 0 done, 1 a design or verification failed, 2 "
        "wrong usage or input.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"lbt-synth {lbt_synth.__version__}")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, help="one of those below"
    )
    for name, add_arguments in COMMANDS.items():
        text = " ".join((add_arguments.__doc__ or "").split())
        # a script for a shell has the commands with a help; the groups list them for the others
        listed: dict[str, Any] = {"help": text} if len(named) > 1 else {}
        command = commands.add_parser(name, description=text, **listed)
        arguments.add_switch(command, "--json", "print one JSON object instead")
        if name in named:
            add_arguments(command)
    return parser


def _list_commands() -> str:
    """Return the commands in their groups, each with the first sentence of its help."""
    lines = []
    for title, group in GROUPS.items():
        lines += ["", title]
        for add_arguments in group:
            name, text = add_arguments.__name__.replace("_", "-"), add_arguments.__doc__ or ""
            first = f"  {name:{_NAME_WIDTH - 2}}"
            lines += wrap(
                text.splitlines()[0].rstrip("."),
                _WIDTH,
                initial_indent=first,
                subsequent_indent=" " * _NAME_WIDTH,
            )
    return "\n".join(lines[1:])


def command_options(name: str) -> dict[str, tuple[str, Any]]:
    """Return the longest spelling and the default of each option of a command, by its argument."""
    commands = build_parser(name)._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    actions = cast(dict[str, argparse.ArgumentParser], commands)[name]._actions
    return {
        action.dest: (max(action.option_strings, key=len), action.default)
        for action in actions
        if action.option_strings and action.dest != "help"
    }


def run_completion(arguments: Namespace) -> Report:
    """Print the script of a shell, made from the arguments of all commands."""
    import shtab  # neither is needed to build the parser of another command

    from lbt_synth.cli.output import Report

    parser = build_parser(*COMMANDS)
    for action in _takes_files(parser):
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
