"""Arguments of the studies."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import (
    add_config,
    add_gains,
    add_option,
    add_output,
    add_outputs,
    add_switch,
)


def robustness(parser: ArgumentParser) -> None:
    """Compute the Strehl ratio against an error of all vibration frequencies.

    It is that of filters redesigned at each error, or of the designs of gain files at many sensor
    gains.
    """
    add_config(parser)
    add_gains(parser)
    redesigned = parser.add_argument_group("without gain files")
    add_option(redesigned, "--gamma-ratio", float, "H-infinity bound of each row")
    add_option(redesigned, "--sensor-gain", float, "real sensor gain")
    fixed = parser.add_argument_group("with gain files")
    ends = ("LOW", "HIGH", "COUNT")
    for name, text in (
        ("--errors-hz", "frequency in the design less the true one [Hz]"),
        ("--sensor-gains", "real sensor gain"),
    ):
        text += ": COUNT values (default: the configuration's)"
        add_option(fixed, name, float, text, nargs=3, metavar=ends)
    text = "real delay less that of the design [frames] (default: the configuration's, else 0)"
    add_option(fixed, "--delay-errors", float, text, nargs="+", metavar="FRAMES")
    add_outputs(parser)


def tradeoff(parser: ArgumentParser) -> None:
    """Design filters from the least norm to the least variance, and compare their sensor gains."""
    add_config(parser)
    text = "levels of the norm, from the least of any filter to that of the Kalman filter, 2 to 200"
    add_option(parser, "--points", int, text, 9)
    text = "past innovations that the mixed filters (least variance at each norm) weigh, 1 to 64"
    add_option(parser, "--taps", int, text, 16)
    add_outputs(parser)


def limits(parser: ArgumentParser) -> None:
    """Show how far designs are from the least residual of any linear controller."""
    add_config(parser)
    add_gains(
        parser,
        text="gain files to add to the integrator, the Kalman and the H-infinity filter of the "
        "configuration",
    )
    add_outputs(parser)


def mirror(parser: ArgumentParser) -> None:
    """Show the step of the mirror's local loop, and what ignoring its dynamics costs."""
    add_config(parser)
    text = "half width of the band in which the mirror counts as settled"
    add_option(parser, "--tolerance", float, text, 0.1)
    add_outputs(parser)


def modal(parser: ArgumentParser) -> None:
    """Compare integrators, optimised gains and Kalman filters for all modes of the mirror."""
    add_config(parser)
    add_option(parser, "--modes", int, "number of modes, at least 2 (default: mirror.modes)")
    add_outputs(parser)


def study(parser: ArgumentParser) -> None:
    """Try controllers on many samples of what the loop may meet; resumes if started again."""
    parser.add_argument("study", metavar="file", help="study file (YAML)")
    add_output(parser, "directory of the study")
    engine = parser.add_mutually_exclusive_group()
    add_option(engine, "--jobs", int, "processes", 1)
    text = "Dask scheduler that runs it instead, as tcp://host:8786"
    add_option(engine, "--dask", str, text, metavar="ADDRESS")
    add_switch(parser, "--pdf", "write the page as a PDF, too (summary.pdf)")
    instead = parser.add_mutually_exclusive_group()
    add_switch(instead, "--dry-run", "say how many samples and how long, and write nothing")
    add_option(instead, "--row", int, "recompute one row, and write it as a configuration")


def paper(parser: ArgumentParser) -> None:
    """Compute the tables and figures of Agapito et al. 2008, ours beside theirs."""
    add_output(parser, "directory to write into")
