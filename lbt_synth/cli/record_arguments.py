"""The arguments of what a record does not say: facts, repairs of its commands, prior knowledge."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.argument_kinds import add_option, add_switch
from lbt_synth.identification.accelerometers.units import M_S2
from lbt_synth.storage.display_unit import UNITS


def add_missing_facts(parser: ArgumentParser) -> None:
    """Add what a record's file may not say."""
    facts = parser.add_argument_group("what the file does not say")
    add_option(facts, "--kind", ("closed-loop", "open-loop", "spectrum"))
    add_option(facts, "--frame-rate-hz", float, "frame rate [Hz]")
    add_option(facts, "--delay-frames", float, "total delay [frames]")
    text = "of the measurements: nm, um, m, mas, arcsec, urad, rad; results are shown in it, too"
    add_option(facts, "--unit", str, text)
    add_option(facts, "--show-unit", UNITS, "what results are shown in (JSON and CSV stay in nm)")
    add_option(facts, "--command-unit", str, "of the commands (default: --unit)")
    add_option(facts, "--diameter-m", float, "telescope diameter [m], for angles")
    add_option(facts, "--obstruction", float, "as a fraction of the diameter")
    add_option(facts, "--averages", int, "periodograms that a spectrum is the mean of")
    add_option(facts, "--commands", str, "another file, with the commands")
    text = "columns by name or number from 0, as in measurements=tip,tilt commands=3,4"
    add_option(facts, "--columns", str, text, nargs="+", metavar="ROLE=NAME")
    add_option(facts, "--axes", int, "which of several columns or modes, from 0", nargs="+")


def add_repairs(parser: ArgumentParser) -> None:
    """Add what the commands of a record need."""
    text = "what the commands need, in this order, to be those that the mirror followed"
    needs = parser.add_argument_group("what the commands need", text)
    add_switch(needs, "--command-increments", "they are increments: add them up")
    text = "frames by which they move to later frames, or to earlier ones below 0"
    add_option(needs, "--command-shift-frames", int, text, 0)
    add_switch(needs, "--swap-axes", "exchange those of the two axes")
    add_option(needs, "--command-sign", int, "1 or -1, of both axes or of each", nargs="+")
    text = "matrix from them to the axes of the measurements, row after row"
    add_option(needs, "--command-matrix", float, text, nargs="+", metavar="NUMBER")
    text = "factor, of both axes or of each; 1 says that they were recorded as large as applied"
    add_option(needs, "--command-scale", float, text, nargs="+")


def add_prior_knowledge(parser: ArgumentParser) -> None:
    """Add what is known before an identification."""
    known = parser.add_argument_group("what is known beforehand")
    add_option(known, "--sensor-gain", float, "sensor gain, of both axes or of each", nargs="+")
    text = "sensor gain where the data do not determine it"
    add_option(known, "--assumed-gain", float, text, 1.0)
    add_option(known, "--lines-hz", float, "frequencies of vibrations [Hz]", nargs="+")
    add_option(known, "--lines-error-hz", float, "standard error of --lines-hz [Hz]", 0.1)
    add_option(known, "--lines-file", str, "text file with one frequency per row [Hz]")
    text = (
        "NPY or CSV with one column per channel and one row per frame of the record: what is "
        "coherent with it is expected as a line"
    )
    add_option(known, "--accelerometers", str, text)
    text = "their rate (default: that of the file's times or header, else the frame rate) [Hz]"
    add_option(known, "--accelerometer-rate-hz", float, text)
    text = f"their unit: {', '.join(M_S2)} (default: that of the headings, else m/s2)"
    add_option(known, "--acceleration-unit", tuple(M_S2), text, metavar="UNIT")
    add_option(known, "--lowest-line-hz", float, "what is below counts as turbulence [Hz]", 3.0)
    add_option(known, "--most-lines", int, "most vibrations per axis", 20)


def add_acceptance(parser: ArgumentParser) -> None:
    """Add the way past a record that is refused."""
    text = "go on although the commands do not reach the measurements as given"
    add_switch(parser, "--accept-record", text)


def add_series(parser: ArgumentParser) -> None:
    """Add a record, or a series, and all that it may not say."""
    parser.add_argument(
        "file",
        help="what the loop recorded: telemetry, or FITS, NPY, NPZ or CSV with measurements "
        "and commands, or an open-loop series (identify: or a spectrum)",
    )
    add_missing_facts(parser)
    add_repairs(parser)
    add_prior_knowledge(parser)
    add_option(parser, "--wavelength-um", float, "of Strehl ratios (default: the file's, or 2.2)")


def add_record(parser: ArgumentParser) -> None:
    """Add a record that is fitted, and its figure."""
    add_series(parser)
    add_acceptance(parser)
    add_option(parser, "--figure", str, "figure to write (default: the output's name, .png)")
    add_switch(parser, "--no-figure", "write no figure")
