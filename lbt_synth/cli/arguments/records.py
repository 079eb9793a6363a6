"""Arguments of the commands that read what a loop recorded: identify and auto."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import GAIN_FILE, add_option, add_output, add_switch


def identify(parser: ArgumentParser) -> None:
    """Identify turbulence, vibrations, noise and sensor gain from a record."""
    _add_record(parser)
    add_output(parser, "configuration to write (.yaml)")


def auto(parser: ArgumentParser) -> None:
    """Go from a record to a gain file: identify, design, certify, test on unseen data."""
    from lbt_synth.methods.registry import record_methods

    _add_record(parser)
    add_option(parser, "--method", record_methods(), "default: the Kalman filter")
    text = "norm as a multiple of the least norm, for methods with a bound"
    add_option(parser, "--gamma-ratio", float, text, 1.2)
    add_option(parser, "--model", str, "configuration to write (default: the output's name, .yaml)")
    add_output(parser, GAIN_FILE)


def _add_record(parser: ArgumentParser) -> None:
    parser.add_argument(
        "file",
        help="what the loop recorded: telemetry, or FITS, NPY, NPZ or CSV with measurements "
        "and commands, or an open-loop series (identify: or a spectrum)",
    )
    _add_missing_facts(parser)
    _add_prior_knowledge(parser)
    add_option(parser, "--wavelength-um", float, "of Strehl ratios", 2.2)
    add_option(parser, "--figure", str, "figure to write (default: the output's name, .png)")
    add_switch(parser, "--no-figure", "write no figure")


def _add_missing_facts(parser: ArgumentParser) -> None:
    facts = parser.add_argument_group("what the file does not say")
    add_option(facts, "--kind", ("closed-loop", "open-loop", "spectrum"))
    add_option(facts, "--frame-rate-hz", float, "frame rate [Hz]")
    add_option(facts, "--delay-frames", float, "total delay [frames]")
    add_option(facts, "--unit", str, "of the measurements: nm, um, m, mas, arcsec, urad, rad")
    add_option(facts, "--command-unit", str, "of the commands (default: --unit)")
    add_option(facts, "--diameter-m", float, "telescope diameter [m], for angles")
    add_option(facts, "--obstruction", float, "as a fraction of the diameter")
    add_option(facts, "--averages", int, "periodograms that a spectrum is the mean of")
    add_option(facts, "--commands", str, "another file, with the commands")
    text = "columns by name or number from 0, as in measurements=tip,tilt commands=3,4"
    add_option(facts, "--columns", str, text, nargs="+", metavar="ROLE=NAME")
    add_option(facts, "--axes", int, "which of several columns or modes, from 0", nargs="+")


def _add_prior_knowledge(parser: ArgumentParser) -> None:
    known = parser.add_argument_group("what is known beforehand")
    add_option(known, "--sensor-gain", float, "sensor gain, of both axes or of each", nargs="+")
    text = "sensor gain where the data do not determine it"
    add_option(known, "--assumed-gain", float, text, 1.0)
    add_option(known, "--lines-hz", float, "frequencies of vibrations [Hz]", nargs="+")
    add_option(known, "--lines-error-hz", float, "standard error of --lines-hz [Hz]", 0.1)
    add_option(known, "--lines-file", str, "text file with one frequency per row [Hz]")
    text = (
        "NPY or CSV with one column per sensor and one row per frame of the record: what is "
        "coherent with it is expected as a line"
    )
    add_option(known, "--accelerometers", str, text)
    add_option(known, "--lowest-line-hz", float, "what is below counts as turbulence [Hz]", 3.0)
    add_option(known, "--most-lines", int, "most vibrations per axis", 20)
