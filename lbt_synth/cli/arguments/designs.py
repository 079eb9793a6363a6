"""Arguments of the commands about gain files; the docstrings are the help of the commands."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import (
    FIGURE,
    GAIN_FILE,
    add_config,
    add_gain,
    add_gains,
    add_option,
    add_output,
    add_switch,
)


def design(parser: ArgumentParser) -> None:
    """Design a controller and write its gain file."""
    from lbt_synth.cli.arguments.method_options import add_method_options

    add_config(parser)
    add_method_options(parser)
    add_output(parser, GAIN_FILE)


def show(parser: ArgumentParser) -> None:
    """Show a gain file: design, loop, margins, certificate."""
    add_gain(parser)
    add_switch(parser, "--matrices", "print the gains and the controller")


def verify(parser: ArgumentParser) -> None:
    """Recompute the certificate of a gain file."""
    add_gain(parser)


def export(parser: ArgumentParser) -> None:
    """Write the controller of a gain file for a real-time computer or another program."""
    add_gain(parser)
    add_option(
        parser,
        "--format",
        ("c", "mat", "iir"),
        "c: C99 source and header; mat: MATLAB; iir: transfer functions for SPECULA's IirFilter "
        "(axes that decouple)",
        required=True,
    )
    types = ("double", "single")
    add_option(parser, "--precision", types, "c: type of all numbers (default double)")
    text = "c: prefix of the C names (default: the output's name without its ending)"
    add_option(parser, "--name", str, text)
    add_output(parser, "file to write: .c (the .h goes beside it), .mat or .fits")


def sigma(parser: ArgumentParser) -> None:
    """Plot singular values of one or several designs."""
    add_gains(parser, "+")
    text = "real sensor gain, as a factor on the one that each design assumes"
    add_option(parser, "--sensor-gain", float, text, 1.0)
    add_output(parser, FIGURE)


def report(parser: ArgumentParser) -> None:
    """Write a page about designs in the loop of a configuration."""
    add_config(parser)
    add_gains(parser, "+")
    add_option(parser, "--title", str, "heading of the page (default: names the configuration)")
    add_option(parser, "--pdf", str, "write the same as a PDF, too (.pdf)", metavar="FILE")
    add_output(parser, "page to write, one file that opens offline (.html)")
