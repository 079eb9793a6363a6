"""Kinds of arguments that several commands have: options, switches, files and outputs."""

from __future__ import annotations

from argparse import Action, ArgumentError, ArgumentParser, Namespace, _ActionsContainer
from collections.abc import Sequence
from typing import Any

GAIN_FILE = "gain file (.fits or .npz)"
FIGURE = "figure (.png, .pdf or .svg)"


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


def option_name(argument: str) -> str:
    """Return an option as people write it, by the name of its argument."""
    return f"--{argument.replace('_', '-')}"


def given_options(arguments: Namespace, *names: str) -> dict[str, Any]:
    """Return the options of those names that the command line gives."""
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def add_switch(parser: _ActionsContainer, name: str, text: str) -> None:
    """Add an option without a value."""
    parser.add_argument(name, action="store_true", help=text)


def add_config(parser: ArgumentParser) -> None:
    """Add a configuration."""
    parser.add_argument("config", help="configuration file (YAML)")


def add_gain(parser: ArgumentParser) -> None:
    """Add one gain file."""
    parser.add_argument("gain", help=GAIN_FILE)


def add_gains(parser: ArgumentParser, nargs: str = "*", text: str = GAIN_FILE) -> None:
    """Add gain files."""
    # without a default, argparse calls them required
    parser.add_argument("gains", nargs=nargs, metavar="gain", help=text, default=[])


class OnlyOutput(Action):
    """Take the name of the output; refuse a second one, which would not be written."""

    def __call__(
        self,
        parser: ArgumentParser,
        namespace: Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Store the name."""
        if getattr(namespace, self.dest) is not self.default:
            raise ArgumentError(self, "give it once")
        setattr(namespace, self.dest, values)


def add_output(
    parser: ArgumentParser, text: str, *, required: bool = True, default: str | None = None
) -> None:
    """Add one output."""
    parser.add_argument(
        "-o", "--output", action=OnlyOutput, required=required, default=default, help=text
    )


def add_unit(parser: ArgumentParser) -> None:
    """Add the unit of wavefronts in tables, texts, figures and pages."""
    from lbt_synth.storage.display_unit import UNITS

    text = "what tables, figures and pages show wavefronts in (default nm; JSON and CSV stay in nm)"
    add_option(parser, "--unit", UNITS, text)


def add_outputs(parser: ArgumentParser) -> None:
    """Add any number of tables and figures."""
    text = "table (.csv) or figure (.png, .pdf, .svg); repeatable"
    parser.add_argument("-o", "--output", action="append", default=[], help=text)


class TargetChoice(Action):
    """Take the name of a target; without one, print all of them and end."""

    def __call__(
        self,
        parser: ArgumentParser,
        namespace: Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Store the name, or print the targets."""
        if values is None:
            _list_targets()
            parser.exit()
        setattr(namespace, self.dest, values)


def _list_targets() -> None:
    """Print how each target computes."""
    from lbt_synth.cli.output import Report  # needs what makes help slow
    from lbt_synth.interop import target_named
    from lbt_synth.interop.target import target_names
    from lbt_synth.storage.rows import fact_table

    report = Report()
    for name in target_names():
        target = target_named(name)
        report.tables.append(fact_table(f"{name}: {target.file}", target.arithmetic))
    report.print(as_json=False)


def add_faults(parser: ArgumentParser) -> None:
    """Add the options of a mirror of little stroke, and of sensors that fail, in a run."""
    add_option(parser, "--stroke", float, "largest command that the mirror applies [nm]")
    parser.add_argument(
        "--drop",
        action="append",
        metavar="SENSOR@START[..END][:READING]",
        help="a sensor or channel that fails [s], as in m2@10s or wavefront@20s..20.2s; READING "
        "missing (seen, default), zero or frozen (believed)",
    )


def add_engine(parser: ArgumentParser) -> None:
    """Add what runs the samples of a study."""
    engine = parser.add_mutually_exclusive_group()
    add_option(engine, "--jobs", int, "processes", 1)
    text = "Dask scheduler that runs it instead, as tcp://host:8786; it can run code here: trust it"
    add_option(engine, "--dask", str, text, metavar="ADDRESS")
    text = "files of the authority, certificate and key for a scheduler at tls://host:8786"
    metavar = ("CA", "CERT", "KEY")
    add_option(parser, "--dask-tls", str, text, nargs=3, metavar=metavar)
