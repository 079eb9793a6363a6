"""Arguments of the commands that read what a loop recorded: identify and auto."""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.arguments.shared import GAIN_FILE, add_output


def add_identify(parser: ArgumentParser) -> None:
    """Add the arguments of identify."""
    _add_record(parser)
    add_output(parser, "configuration to write (.yaml)")


def add_auto(parser: ArgumentParser) -> None:
    """Add the arguments of auto."""
    from lbt_synth.methods.registry import record_methods

    _add_record(parser)
    parser.add_argument("--method", choices=record_methods(), help="default: the Kalman filter")
    parser.add_argument(
        "--gamma-ratio",
        type=float,
        default=1.2,
        help="norm as a multiple of the least norm, for methods with a bound (default 1.2)",
    )
    parser.add_argument(
        "--model", help="configuration to write (default: the output's name, .yaml)"
    )
    add_output(parser, GAIN_FILE)


def _add_record(parser: ArgumentParser) -> None:
    parser.add_argument(
        "file",
        help="what the loop recorded: telemetry, or FITS, NPY, NPZ or CSV with measurements "
        "and commands, or an open-loop series (identify: or a spectrum)",
    )
    _add_missing_facts(parser)
    _add_prior_knowledge(parser)
    parser.add_argument(
        "--wavelength-um", type=float, default=2.2, help="of Strehl ratios (default 2.2)"
    )
    parser.add_argument("--figure", help="figure to write (default: the output's name, .png)")
    parser.add_argument("--no-figure", action="store_true", help="write no figure")


def _add_missing_facts(parser: ArgumentParser) -> None:
    facts = parser.add_argument_group("what the file does not say")
    facts.add_argument("--kind", choices=("closed-loop", "open-loop", "spectrum"))
    facts.add_argument("--frame-rate-hz", type=float, help="frame rate [Hz]")
    facts.add_argument("--delay-frames", type=float, help="total delay [frames]")
    facts.add_argument("--unit", help="of the measurements: nm, um, m, mas, arcsec, urad, rad")
    facts.add_argument("--command-unit", help="of the commands (default: --unit)")
    facts.add_argument("--diameter-m", type=float, help="telescope diameter [m], for angles")
    facts.add_argument("--obstruction", type=float, help="as a fraction of the diameter")
    facts.add_argument("--averages", type=int, help="periodograms that a spectrum is the mean of")
    facts.add_argument("--commands", help="another file, with the commands")
    facts.add_argument(
        "--columns",
        nargs="+",
        metavar="ROLE=NAME",
        help="columns by name or number from 0, as in measurements=tip,tilt commands=3,4",
    )
    facts.add_argument(
        "--axes", nargs="+", type=int, help="which of several columns or modes, from 0"
    )


def _add_prior_knowledge(parser: ArgumentParser) -> None:
    known = parser.add_argument_group("what is known beforehand")
    known.add_argument(
        "--sensor-gain", nargs="+", type=float, help="sensor gain, of both axes or of each"
    )
    known.add_argument(
        "--assumed-gain",
        type=float,
        default=1.0,
        help="sensor gain where the data do not determine it (default 1)",
    )
    known.add_argument("--lines-hz", nargs="+", type=float, help="frequencies of vibrations [Hz]")
    known.add_argument(
        "--lines-error-hz",
        type=float,
        default=0.1,
        help="standard error of --lines-hz [Hz] (default 0.1)",
    )
    known.add_argument("--lines-file", help="text file with one frequency per row [Hz]")
    known.add_argument(
        "--accelerometers",
        help="NPY or CSV with one column per sensor and one row per frame of the record: what is "
        "coherent with it is expected as a line",
    )
    known.add_argument(
        "--lowest-line-hz",
        type=float,
        default=3.0,
        help="what is below counts as turbulence [Hz] (default 3)",
    )
    known.add_argument(
        "--most-lines", type=int, default=20, help="most vibrations per axis (default 20)"
    )
