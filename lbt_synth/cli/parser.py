"""Arguments of ``lbt-synth``; nothing heavy is imported for them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import lbt_synth


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="lbt-synth",
        description="Design, certify and analyse tip/tilt controllers that reject vibrations.",
        epilog="Exit status: 0 done, 1 a design or verification failed, 2 wrong usage or input.",
    )
    parser.add_argument("--version", action="version", version=f"lbt-synth {lbt_synth.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, text: str, **extra: Any) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text + ".", **extra)
        sub.add_argument("--json", action="store_true", help="print one JSON object instead")
        return sub

    config_help = "configuration file (YAML)"
    gain_help = "gain file (.fits, .npz or .json)"

    design = command("design", "Design a controller and write its gain file")
    design.add_argument("config", help=config_help)
    design.add_argument(
        "--method",
        choices=("kalman", "hinf", "mixed", "lqg", "robust", "polytopic", "integrator"),
        required=True,
    )
    design.add_argument(
        "--route",
        choices=("riccati", "sdp", "lmi"),
        help="kalman: riccati (default) or sdp; hinf: lmi (default up to 20 states) or riccati",
    )
    bound = design.add_mutually_exclusive_group()
    bound.add_argument("--gamma", type=float, help="bound of the H-infinity norm [nm]")
    bound.add_argument(
        "--gamma-ratio",
        type=float,
        help="the same as a multiple of the least one (default: the configuration's, else 1.2)",
    )
    bound.add_argument(
        "--rms",
        type=float,
        help="mixed, instead of a bound of the norm: bound of the estimation error [nm rms]; the "
        "norm is then made least",
    )
    design.add_argument(
        "--taps",
        type=int,
        help="mixed: past innovations that the filter weighs, 1 to 64 (default 16)",
    )
    design.add_argument(
        "--norm",
        choices=("hinf", "h2"),
        help="polytopic: what is made least over the interval, the H-infinity norm (default) or "
        "the rms",
    )
    design.add_argument(
        "--half-width-hz",
        type=float,
        help="polytopic: half width of the interval of vibration frequencies [Hz]",
    )
    design.add_argument(
        "--command-weight",
        type=float,
        help="lqg: weight of the squared command beside the squared residual (default: the "
        "configuration's, else 0)",
    )
    design.add_argument(
        "--horizon",
        type=int,
        default=1,
        help="frames from the newest measurement to the estimate (default 1): the filter is for a "
        "loop with a delay of loop.delay_frames + horizon - 1, at least 1 frame",
    )
    design.add_argument(
        "--gain", type=float, help="integrator gain (default: the best for the truth)"
    )
    design.add_argument("-o", "--output", required=True, help=gain_help)

    show = command("show", "Show a gain file: design, loop, margins, certificate")
    show.add_argument("gain", help=gain_help)
    show.add_argument("--matrices", action="store_true", help="print the gains and the controller")

    verify = command("verify", "Compute the certificate of a gain file anew")
    verify.add_argument("gain", help=gain_help)

    export = command(
        "export", "Write the controller of a gain file for a real-time computer or another program"
    )
    export.add_argument("gain", help=gain_help)
    export.add_argument(
        "--format",
        choices=("c", "mat", "iir"),
        required=True,
        help="c: C99 source and header; mat: MATLAB; iir: transfer functions for SPECULA's "
        "IirFilter (axes that decouple)",
    )
    export.add_argument(
        "--precision",
        choices=("double", "single"),
        help="c: type of all numbers (default double)",
    )
    export.add_argument(
        "--name", help="c: prefix of the C names (default: the output's name without its ending)"
    )
    export.add_argument(
        "-o",
        "--output",
        required=True,
        help="file to write: .c (the .h goes beside it), .mat or .fits",
    )

    sigma = command("sigma", "Plot singular values of one or several designs")
    sigma.add_argument("gains", nargs="+", metavar="gain", help=gain_help)
    sigma.add_argument(
        "--sensor-gain",
        type=float,
        default=1.0,
        help="real sensor gain, as a factor on the one that each design assumes (default 1)",
    )
    sigma.add_argument("-o", "--output", required=True, help="figure (.png, .pdf or .svg)")

    simulate = command("simulate", "Close the loop in the time domain, beside the exact answer")
    simulate.add_argument("config", help=config_help)
    simulate.add_argument("gain", help=gain_help)
    simulate.add_argument("--frames", type=int, help="frames to keep")
    simulate.add_argument("--cases", type=int, help="independent runs")
    simulate.add_argument("--seed", type=int, help="seed of the random series")
    simulate.add_argument("--sensor-gain", type=float, help="real sensor gain")
    simulate.add_argument("-o", "--output", help="figure (.png, .pdf or .svg)")
    simulate.add_argument(
        "--telemetry",
        metavar="FILE",
        help="write the series of the first run (.fits, .npz or .aot.fits)",
    )

    telemetry = command(
        "telemetry", "Show what a telemetry file holds, and write it in another format"
    )
    telemetry.add_argument("file", help="telemetry (.fits or .npz; FITS of the AOT standard, too)")
    telemetry.add_argument("-o", "--output", help="file to write (.fits, .npz or .aot.fits)")
    telemetry.add_argument(
        "--format",
        choices=("fits", "npz", "aot"),
        help="of the file to write (default: its ending)",
    )
    telemetry.add_argument(
        "--precision",
        choices=("float64", "float32"),
        help="of the series written (default float64)",
    )

    _add_record_commands(command)

    robustness = command(
        "robustness",
        "Strehl ratio over an error of all vibration frequencies of the model: of filters designed "
        "anew at each error, or of the designs of gain files at many sensor gains",
    )
    robustness.add_argument("config", help=config_help)
    robustness.add_argument("gains", nargs="*", metavar="gain", help=gain_help)
    anew = robustness.add_argument_group("without gain files")
    anew.add_argument("--gamma-ratio", type=float, help="H-infinity bound of each row")
    anew.add_argument("--sensor-gain", type=float, help="real sensor gain")
    fixed = robustness.add_argument_group("with gain files")
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
    robustness.add_argument(
        "-o", "--output", action="append", default=[], help="table (.csv) or figure; repeatable"
    )

    tradeoff = command(
        "tradeoff", "Filters from the least norm to the least variance, and their sensor gains"
    )
    tradeoff.add_argument("config", help=config_help)
    tradeoff.add_argument(
        "--points",
        type=int,
        default=9,
        help="levels of the norm, from the least of any filter to that of the Kalman filter, 2 to "
        "200 (default 9)",
    )
    tradeoff.add_argument(
        "--taps",
        type=int,
        default=16,
        help="past innovations that the mixed filters (least variance at each norm) weigh, 1 to 64 "
        "(default 16)",
    )
    tradeoff.add_argument(
        "-o",
        "--output",
        action="append",
        default=[],
        help="table (.csv) or figure (.png, .pdf, .svg); repeatable",
    )

    limits = command(
        "limits", "How far designs are from the least residual of any linear controller"
    )
    limits.add_argument("config", help=config_help)
    limits.add_argument(
        "gains",
        nargs="*",
        metavar="gain",
        help="gain files to add to the integrator, the Kalman and the H-infinity filter of the "
        "configuration",
    )
    limits.add_argument(
        "-o",
        "--output",
        action="append",
        default=[],
        help="table (.csv) or figure (.png, .pdf, .svg); repeatable",
    )

    report = command("report", "Write a page about designs in the loop of a configuration")
    report.add_argument("config", help=config_help)
    report.add_argument("gains", nargs="+", metavar="gain", help=gain_help)
    report.add_argument("--title", help="heading of the page (default: names the configuration)")
    report.add_argument("--pdf", metavar="FILE", help="write the same as a PDF, too (.pdf)")
    report.add_argument(
        "-o", "--output", required=True, help="page to write, one file that opens offline (.html)"
    )

    end_to_end = command("e2e", "Close the loop end to end: pyramid, mirror and moving air")
    table = command("e2e-table", "Tables II and III of Agapito et al. 2008 end to end")
    for sub in (end_to_end, table):
        sub.add_argument("config", help=config_help)
        sub.add_argument("--pixels", type=int, help="pixels across the pupil, even")
        sub.add_argument("--frames", type=int, help="frames of an exposure")
        sub.add_argument("--settle-frames", type=int, help="frames before, at least 200")
        sub.add_argument("--seed", type=int, help="seed of the random parts, the first of several")
        sub.add_argument("--cache", help="directory for calibrations and phase screens")
        sub.add_argument("-o", "--output", required=True, help="directory to write into")
    end_to_end.add_argument("gain", help=gain_help)
    table.add_argument(
        "gains", nargs="*", metavar="gain", help="gain files to run beside the paper's filters"
    )
    table.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    table.add_argument(
        "--seeds", type=int, default=3, help="seeds of Table II and of 20 Hz (default 3)"
    )
    table.add_argument(
        "--row-seeds", type=int, default=1, help="seeds of the other rows (default 1)"
    )
    table.add_argument(
        "--tables", nargs="+", choices=("II", "III"), default=["II", "III"], help="default both"
    )

    mirror = command(
        "mirror", "The mirror's local loop: its step, and what ignoring its dynamics costs"
    )
    mirror.add_argument("config", help=config_help)
    mirror.add_argument(
        "--tolerance",
        type=float,
        default=0.1,
        help="half width of the band in which the mirror counts as settled (default 0.1)",
    )
    mirror.add_argument(
        "-o",
        "--output",
        action="append",
        default=[],
        help="table (.csv) or figure (.png, .pdf, .svg); repeatable",
    )

    modal = command(
        "modal", "Integrators, optimised gains and Kalman filters for all modes of the mirror"
    )
    modal.add_argument("config", help=config_help)
    modal.add_argument(
        "--modes", type=int, help="number of modes, at least 2 (default: mirror.modes)"
    )
    modal.add_argument(
        "-o",
        "--output",
        action="append",
        default=[],
        help="table (.csv) or figure (.png, .pdf, .svg); repeatable",
    )

    _add_study_command(command)

    paper = command("paper", "Tables and figures of Agapito et al. 2008, ours beside theirs")
    paper.add_argument("-o", "--output", required=True, help="directory to write into")
    return parser


def _add_study_command(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the robustness study."""
    study = command(
        "study",
        "Try controllers on many samples of what the loop may meet; resumes if started again",
    )
    study.add_argument("study", metavar="file", help="study file (YAML)")
    study.add_argument("-o", "--output", required=True, help="directory of the study")
    engine = study.add_mutually_exclusive_group()
    engine.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    engine.add_argument(
        "--dask", metavar="ADDRESS", help="Dask scheduler that runs it instead, as tcp://host:8786"
    )
    study.add_argument(
        "--pdf", action="store_true", help="write the page as a PDF, too (summary.pdf)"
    )
    instead = study.add_mutually_exclusive_group()
    instead.add_argument(
        "--dry-run",
        action="store_true",
        help="say how many samples and how long, and write nothing",
    )
    instead.add_argument(
        "--row", type=int, help="compute one row anew, and write it as a configuration"
    )


def _add_record_commands(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the commands that read what a loop recorded."""
    identify = command(
        "identify", "Identify turbulence, vibrations, noise and sensor gain from a record"
    )
    auto = command(
        "auto", "From a record to a gain file: identify, design, certify, test on unseen data"
    )
    for sub in (identify, auto):
        sub.add_argument(
            "file",
            help="what the loop recorded: telemetry, or FITS, NPY, NPZ or CSV with measurements "
            "and commands, or an open-loop series (identify: or a spectrum)",
        )
        facts = sub.add_argument_group("what the file does not tell")
        facts.add_argument("--kind", choices=("closed-loop", "open-loop", "spectrum"))
        facts.add_argument("--frame-rate-hz", type=float, help="frame rate [Hz]")
        facts.add_argument("--delay-frames", type=float, help="total delay [frames]")
        facts.add_argument("--unit", help="of the measurements: nm, um, m, mas, arcsec, urad, rad")
        facts.add_argument("--command-unit", help="of the commands (default: --unit)")
        facts.add_argument("--diameter-m", type=float, help="telescope diameter [m], for angles")
        facts.add_argument("--obstruction", type=float, help="as a fraction of the diameter")
        facts.add_argument(
            "--averages", type=int, help="periodograms that a spectrum is the mean of"
        )
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
        known = sub.add_argument_group("what is known beforehand")
        known.add_argument(
            "--sensor-gain", nargs="+", type=float, help="sensor gain, of both axes or of each"
        )
        known.add_argument(
            "--assumed-gain",
            type=float,
            default=1.0,
            help="sensor gain where the data do not tell it (default 1)",
        )
        known.add_argument(
            "--lines-hz", nargs="+", type=float, help="frequencies of vibrations [Hz]"
        )
        known.add_argument(
            "--lines-error-hz",
            type=float,
            default=0.1,
            help="standard error of --lines-hz [Hz] (default 0.1)",
        )
        known.add_argument("--lines-file", help="text file with a frequency a row [Hz]")
        known.add_argument(
            "--accelerometers",
            help="NPY or CSV with a column a sensor, frame by frame beside the record: what is "
            "coherent with it is expected as a line",
        )
        known.add_argument(
            "--lowest-line-hz",
            type=float,
            default=3.0,
            help="what is below counts as turbulence [Hz] (default 3)",
        )
        known.add_argument(
            "--most-lines", type=int, default=20, help="vibrations an axis, at most (default 20)"
        )
        sub.add_argument(
            "--wavelength-um", type=float, default=2.2, help="of Strehl ratios (default 2.2)"
        )
        sub.add_argument("--figure", help="figure to write (default: the output's name, .png)")
        sub.add_argument("--no-figure", action="store_true", help="write none")
    identify.add_argument("-o", "--output", required=True, help="configuration to write (.yaml)")
    auto.add_argument(
        "--method", choices=("kalman", "hinf", "lqg"), default="kalman", help="default kalman"
    )
    auto.add_argument(
        "--gamma-ratio", type=float, default=1.2, help="hinf: norm over the least (default 1.2)"
    )
    auto.add_argument("--model", help="configuration to write (default: the output's name, .yaml)")
    auto.add_argument(
        "-o", "--output", required=True, help="gain file to write (.fits, .npz or .json)"
    )
