"""Arguments of the commands about gain files: design, show, verify, export, sigma, report."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import (
    FIGURE,
    GAIN_FILE,
    add_config,
    add_gain,
    add_gains,
    add_output,
)


def add_design(parser: ArgumentParser) -> None:
    """Add the arguments of design."""
    from lbt_synth.cli.arguments.method_options import add_method_options

    add_config(parser)
    add_method_options(parser)
    add_output(parser, GAIN_FILE)


def add_show(parser: ArgumentParser) -> None:
    """Add the arguments of show."""
    add_gain(parser)
    parser.add_argument(
        "--matrices", action="store_true", help="print the gains and the controller"
    )


def add_export(parser: ArgumentParser) -> None:
    """Add the arguments of export."""
    add_gain(parser)
    parser.add_argument(
        "--format",
        choices=("c", "mat", "iir"),
        required=True,
        help="c: C99 source and header; mat: MATLAB; iir: transfer functions for SPECULA's "
        "IirFilter (axes that decouple)",
    )
    parser.add_argument(
        "--precision",
        choices=("double", "single"),
        help="c: type of all numbers (default double)",
    )
    parser.add_argument(
        "--name", help="c: prefix of the C names (default: the output's name without its ending)"
    )
    add_output(parser, "file to write: .c (the .h goes beside it), .mat or .fits")


def add_sigma(parser: ArgumentParser) -> None:
    """Add the arguments of sigma."""
    add_gains(parser, "+")
    parser.add_argument(
        "--sensor-gain",
        type=float,
        default=1.0,
        help="real sensor gain, as a factor on the one that each design assumes (default 1)",
    )
    add_output(parser, FIGURE)


def add_report(parser: ArgumentParser) -> None:
    """Add the arguments of report."""
    add_config(parser)
    add_gains(parser, "+")
    parser.add_argument("--title", help="heading of the page (default: names the configuration)")
    parser.add_argument("--pdf", metavar="FILE", help="write the same as a PDF, too (.pdf)")
    add_output(parser, "page to write, one file that opens offline (.html)")
