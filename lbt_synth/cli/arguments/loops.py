"""Arguments of the commands that run a loop or read its telemetry."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import FIGURE, add_config, add_gain, add_gains, add_output


def add_simulate(parser: ArgumentParser) -> None:
    """Add the arguments of simulate."""
    add_config(parser)
    add_gain(parser)
    parser.add_argument("--frames", type=int, help="frames to keep")
    parser.add_argument("--cases", type=int, help="independent runs")
    parser.add_argument("--seed", type=int, help="seed of the random series")
    parser.add_argument("--sensor-gain", type=float, help="real sensor gain")
    add_output(parser, FIGURE, required=False)
    parser.add_argument(
        "--telemetry",
        metavar="FILE",
        help="write the series of the first run (.fits, .npz or .aot.fits)",
    )


def add_telemetry(parser: ArgumentParser) -> None:
    """Add the arguments of telemetry."""
    parser.add_argument("file", help="telemetry (.fits or .npz; FITS of the AOT standard, too)")
    add_output(parser, "file to write (.fits, .npz or .aot.fits)", required=False)
    parser.add_argument(
        "--format",
        choices=("fits", "npz", "aot"),
        help="of the file to write (default: its ending)",
    )
    parser.add_argument(
        "--precision",
        choices=("float64", "float32"),
        help="of the series written (default float64)",
    )


def add_end_to_end(parser: ArgumentParser) -> None:
    """Add the arguments of end-to-end."""
    _add_simulator(parser)
    add_gain(parser)


def add_end_to_end_table(parser: ArgumentParser) -> None:
    """Add the arguments of end-to-end-table."""
    _add_simulator(parser)
    add_gains(parser, text="gain files to run beside the paper's filters")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument(
        "--seeds", type=int, default=3, help="seeds of Table II and of 20 Hz (default 3)"
    )
    parser.add_argument(
        "--row-seeds", type=int, default=1, help="seeds of the other rows (default 1)"
    )
    parser.add_argument(
        "--tables", nargs="+", choices=("II", "III"), default=["II", "III"], help="default both"
    )


def _add_simulator(parser: ArgumentParser) -> None:
    add_config(parser)
    parser.add_argument("--pixels", type=int, help="pixels across the pupil, even")
    parser.add_argument("--frames", type=int, help="frames of an exposure")
    parser.add_argument("--settle-frames", type=int, help="frames to settle before, at least 200")
    parser.add_argument("--seed", type=int, help="seed of the random parts, the first of several")
    parser.add_argument("--cache", help="directory for calibrations and phase screens")
    add_output(parser, "directory to write into")
