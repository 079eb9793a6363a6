"""Arguments that several commands share."""

from __future__ import annotations

from argparse import ArgumentParser

GAIN_FILE = "gain file (.fits, .npz or .json)"
FIGURE = "figure (.png, .pdf or .svg)"


def add_config(parser: ArgumentParser) -> None:
    """Add a configuration."""
    parser.add_argument("config", help="configuration file (YAML)")


def add_gain(parser: ArgumentParser) -> None:
    """Add one gain file."""
    parser.add_argument("gain", help=GAIN_FILE)


def add_gains(parser: ArgumentParser, nargs: str = "*", text: str = GAIN_FILE) -> None:
    """Add gain files."""
    parser.add_argument("gains", nargs=nargs, metavar="gain", help=text)


def add_output(parser: ArgumentParser, text: str, *, required: bool = True) -> None:
    """Add one output."""
    parser.add_argument("-o", "--output", required=required, help=text)


def add_outputs(parser: ArgumentParser) -> None:
    """Add any number of tables and figures."""
    parser.add_argument(
        "-o",
        "--output",
        action="append",
        default=[],
        help="table (.csv) or figure (.png, .pdf, .svg); repeatable",
    )
