"""Arguments of the commands that run a loop or read its telemetry."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import (
    FIGURE,
    add_config,
    add_gain,
    add_gains,
    add_option,
    add_output,
)


def simulate(parser: ArgumentParser) -> None:
    """Close the loop in the time domain, beside the exact answer."""
    add_config(parser)
    add_gain(parser)
    add_option(parser, "--frames", int, "frames to keep")
    add_option(parser, "--cases", int, "independent runs")
    add_option(parser, "--seed", int, "seed of the random series")
    add_option(parser, "--sensor-gain", float, "real sensor gain")
    add_output(parser, FIGURE, required=False)
    text = "write the series of the first run (.fits, .npz or .aot.fits)"
    add_option(parser, "--telemetry", str, text, metavar="FILE")


def telemetry(parser: ArgumentParser) -> None:
    """Show what a telemetry file holds, and write it in another format."""
    parser.add_argument("file", help="telemetry (.fits or .npz; FITS of the AOT standard, too)")
    add_output(parser, "file to write (.fits, .npz or .aot.fits)", required=False)
    endings = ("fits", "npz", "aot")
    add_option(parser, "--format", endings, "of the file to write (default: its ending)")
    types = ("float64", "float32")
    add_option(parser, "--precision", types, "of the series written (default float64)")


def end_to_end(parser: ArgumentParser) -> None:
    """Close the loop end to end: pyramid, mirror and moving air."""
    _add_simulator(parser)
    add_gain(parser)


def end_to_end_table(parser: ArgumentParser) -> None:
    """Run Tables II and III of Agapito et al. 2008 end to end."""
    _add_simulator(parser)
    add_gains(parser, text="gain files to run beside the paper's filters")
    add_option(parser, "--jobs", int, "processes", 1)
    add_option(parser, "--seeds", int, "seeds of Table II and of 20 Hz", 3)
    add_option(parser, "--row-seeds", int, "seeds of the other rows", 1)
    parser.add_argument(
        "--tables", nargs="+", choices=("II", "III"), default=["II", "III"], help="default both"
    )


def _add_simulator(parser: ArgumentParser) -> None:
    add_config(parser)
    add_option(parser, "--pixels", int, "pixels across the pupil, even")
    add_option(parser, "--frames", int, "frames of an exposure")
    add_option(parser, "--settle-frames", int, "frames to settle before, at least 200")
    add_option(parser, "--seed", int, "seed of the random parts, the first of several")
    add_option(parser, "--cache", str, "directory for calibrations and phase screens")
    add_output(parser, "directory to write into")
