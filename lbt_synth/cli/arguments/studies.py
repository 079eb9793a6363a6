"""Arguments of the studies: robustness, tradeoff, limits, mirror, modal, study, paper."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import add_config, add_gains, add_output, add_outputs


def add_robustness(parser: ArgumentParser) -> None:
    """Add the arguments of robustness."""
    add_config(parser)
    add_gains(parser)
    redesigned = parser.add_argument_group("without gain files")
    redesigned.add_argument("--gamma-ratio", type=float, help="H-infinity bound of each row")
    redesigned.add_argument("--sensor-gain", type=float, help="real sensor gain")
    fixed = parser.add_argument_group("with gain files")
    for option, text in (
        ("--errors-hz", "frequency in the design less the true one [Hz]"),
        ("--sensor-gains", "real sensor gain"),
    ):
        fixed.add_argument(
            option,
            nargs=3,
            type=float,
            metavar=("LOW", "HIGH", "COUNT"),
            help=f"{text}: COUNT values (default: the configuration's)",
        )
    fixed.add_argument(
        "--delay-errors",
        nargs="+",
        type=float,
        metavar="FRAMES",
        help="real delay less that of the design [frames] (default: the configuration's, else 0)",
    )
    add_outputs(parser)


def add_tradeoff(parser: ArgumentParser) -> None:
    """Add the arguments of tradeoff."""
    add_config(parser)
    parser.add_argument(
        "--points",
        type=int,
        default=9,
        help="levels of the norm, from the least of any filter to that of the Kalman filter, 2 to "
        "200 (default 9)",
    )
    parser.add_argument(
        "--taps",
        type=int,
        default=16,
        help="past innovations that the mixed filters (least variance at each norm) weigh, 1 to 64 "
        "(default 16)",
    )
    add_outputs(parser)


def add_limits(parser: ArgumentParser) -> None:
    """Add the arguments of limits."""
    add_config(parser)
    add_gains(
        parser,
        text="gain files to add to the integrator, the Kalman and the H-infinity filter of the "
        "configuration",
    )
    add_outputs(parser)


def add_mirror(parser: ArgumentParser) -> None:
    """Add the arguments of mirror."""
    add_config(parser)
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.1,
        help="half width of the band in which the mirror counts as settled (default 0.1)",
    )
    add_outputs(parser)


def add_modal(parser: ArgumentParser) -> None:
    """Add the arguments of modal."""
    add_config(parser)
    parser.add_argument(
        "--modes", type=int, help="number of modes, at least 2 (default: mirror.modes)"
    )
    add_outputs(parser)


def add_study(parser: ArgumentParser) -> None:
    """Add the arguments of study."""
    parser.add_argument("study", metavar="file", help="study file (YAML)")
    add_output(parser, "directory of the study")
    engine = parser.add_mutually_exclusive_group()
    engine.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    engine.add_argument(
        "--dask", metavar="ADDRESS", help="Dask scheduler that runs it instead, as tcp://host:8786"
    )
    parser.add_argument(
        "--pdf", action="store_true", help="write the page as a PDF, too (summary.pdf)"
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--dry-run",
        action="store_true",
        help="say how many samples and how long, and write nothing",
    )
    instead.add_argument(
        "--row", type=int, help="recompute one row, and write it as a configuration"
    )


def add_paper(parser: ArgumentParser) -> None:
    """Add the arguments of paper."""
    add_output(parser, "directory to write into")
