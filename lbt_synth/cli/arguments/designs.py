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
    add_config(parser)
    parser.add_argument(
        "--method",
        choices=("kalman", "hinf", "mixed", "lqg", "robust", "polytopic", "integrator"),
        required=True,
    )
    parser.add_argument(
        "--route",
        choices=("riccati", "sdp", "lmi"),
        help="kalman: riccati (default) or sdp; hinf: lmi (default up to 20 states) or riccati",
    )
    _add_bound(parser)
    parser.add_argument(
        "--taps",
        type=int,
        help="mixed: past innovations that the filter weighs, 1 to 64 (default 16)",
    )
    parser.add_argument(
        "--norm",
        choices=("hinf", "h2"),
        help="polytopic: what is minimised over the interval, the H-infinity norm (default) or "
        "the rms",
    )
    parser.add_argument(
        "--half-width-hz",
        type=float,
        help="polytopic: half width of the interval of vibration frequencies [Hz]",
    )
    parser.add_argument(
        "--command-weight",
        type=float,
        help="lqg: weight of the squared command beside the squared residual (default: the "
        "configuration's, else 0)",
    )
    parser.add_argument(
        "--horizon",
        type=int,
        default=1,
        help="frames from the newest measurement to the estimate (default 1): the filter is for a "
        "loop with a delay of loop.delay_frames + horizon - 1, at least 1 frame",
    )
    parser.add_argument(
        "--gain", type=float, help="integrator: its gain (default: the best for the truth)"
    )
    add_output(parser, GAIN_FILE)


def _add_bound(parser: ArgumentParser) -> None:
    bound = parser.add_mutually_exclusive_group()
    bound.add_argument("--gamma", type=float, help="hinf, mixed: bound of the H-infinity norm [nm]")
    bound.add_argument(
        "--gamma-ratio",
        type=float,
        help="the same as a multiple of the least norm (default: the configuration's, else 1.2)",
    )
    bound.add_argument(
        "--rms",
        type=float,
        help="mixed: bound of the estimation error [nm rms] instead, under which the norm is "
        "minimised",
    )


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
