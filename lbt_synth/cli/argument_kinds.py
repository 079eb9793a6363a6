"""Kinds of arguments that several commands have: options, switches, files and outputs."""

from __future__ import annotations

from argparse import Action, ArgumentParser, Namespace, _ActionsContainer
from collections.abc import Mapping, Sequence
from typing import Any

from lbt_synth.storage.display_unit import UNITS

GAIN_FILE = "gain file (.fits or .npz)"
FIGURE = "figure (.png, .pdf or .svg)"
_SHARED: Mapping[str, dict[str, Any]] = {
    "config": {"help": "configuration file (YAML)"},
    "gain": {"help": GAIN_FILE},
    "--unit": {
        "choices": UNITS,
        "help": "what tables, figures and pages show wavefronts in (default nm; JSON and CSV stay "
        "in nm)",
    },
    "--output": {
        "action": "append",
        "default": [],
        "help": "table (.csv) or figure (.png, .pdf, .svg); repeatable",
    },
    "--pdf": {"metavar": "FILE", "help": "write the same as a PDF, too (.pdf)"},
    "--jobs": {"type": int, "default": 1, "help": "processes (default 1)"},
    "--stroke": {"type": float, "help": "largest command that the mirror applies [nm]"},
    "--wavelength-um": {"type": float, "help": "of Strehl ratios (default: the file's, or 2.2)"},
}


def add_shared(parser: _ActionsContainer, *names: str) -> None:
    """Add arguments that are the same in several commands."""
    for name in names:
        flags = ("-o", name) if name == "--output" else (name,)
        parser.add_argument(*flags, **_SHARED[name])


def add_option(
    parser: _ActionsContainer,
    name: str,
    kind: type[Any] | Sequence[str],
    text: str = "",
    default: float | None = None,
    **more: Any,
) -> None:
    """Add an option of a type or of some choices; its help ends with its default."""
    if default is not None:
        text += f" (default {default:g})"
    more |= {"type": kind} if isinstance(kind, type) else {"choices": kind}
    parser.add_argument(name, help=text, default=default, **more)


def add_switch(parser: _ActionsContainer, name: str, text: str) -> None:
    """Add an option without a value."""
    parser.add_argument(name, action="store_true", help=text)


def option_name(argument: str) -> str:
    """Return an option as people write it, by the name of its argument."""
    return f"--{argument.replace('_', '-')}"


def given_options(arguments: Namespace, *names: str) -> dict[str, Any]:
    """Return the options of those names that the command line gives."""
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def add_gains(parser: ArgumentParser, nargs: str = "*", text: str = GAIN_FILE) -> None:
    """Add gain files."""
    # without a default, argparse calls them required
    parser.add_argument("gains", nargs=nargs, metavar="gain", help=text, default=[])


def add_output(
    parser: ArgumentParser, text: str, *, required: bool = True, default: str | None = None
) -> None:
    """Add one output."""
    parser.add_argument("-o", "--output", required=required, default=default, help=text)


class TargetChoice(Action):
    """Take the name of a target; without one, print all of them and end."""

    def __call__(
        self, parser: ArgumentParser, namespace: Namespace, values: Any, option: Any = None
    ) -> None:
        """Store the name, or print how each target computes."""
        if values is not None:
            setattr(namespace, self.dest, values)
            return
        from lbt_synth.cli.output import Report  # needs what makes help slow
        from lbt_synth.interop import target_named
        from lbt_synth.interop.pipeline import target_names
        from lbt_synth.storage.rows import fact_table

        targets = {name: target_named(name) for name in target_names()}
        Report(
            tables=[
                fact_table(f"{name}: {target.file}", target.arithmetic)
                for name, target in targets.items()
            ]
        ).print(as_json=False)
        parser.exit()
