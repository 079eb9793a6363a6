"""The arguments of each command, declared apart from what runs it so that help stays quick.

The docstring of a function that adds the arguments of a command is the help of the command.
"""

from __future__ import annotations

from argparse import ArgumentParser

from lbt_synth.cli.argument_kinds import (
    FIGURE,
    GAIN_FILE,
    TargetChoice,
    add_config,
    add_engine,
    add_faults,
    add_gain,
    add_gains,
    add_option,
    add_output,
    add_outputs,
    add_switch,
    add_unit,
)
from lbt_synth.cli.record_arguments import (
    add_missing_facts,
    add_record,
    add_repairs,
    add_series,
)


def init(parser: ArgumentParser) -> None:
    """Write a commented configuration to begin with."""
    from lbt_synth.config.templates import telescope_names

    text = "published numbers and their sources (default generic: assumed ones)"
    add_option(parser, "--telescope", telescope_names(), text)
    text = "telemetry, for what it knows: timing, telescope, noise, turbulence and lines"
    add_option(parser, "--from", str, text, dest="source", metavar="RECORD")
    add_switch(parser, "--examples", "write the examples of the documentation instead (folder)")
    add_switch(parser, "--schema", "print the JSON schema for editors instead (.json)")
    add_switch(parser, "--force", "replace files that are there")
    add_output(parser, "file to write (default: telescope or record, .yaml)", required=False)


def design(parser: ArgumentParser) -> None:
    """Design a controller and write its gain file."""
    from lbt_synth.cli.method_options import add_method_options

    add_unit(parser)
    add_config(parser)
    add_method_options(parser)
    add_output(parser, GAIN_FILE)


def show(parser: ArgumentParser) -> None:
    """Show a gain file: design, loop, margins, certificate."""
    add_unit(parser)
    add_gain(parser)
    add_switch(parser, "--matrices", "print the gains and the controller")


def verify(parser: ArgumentParser) -> None:
    """Recompute the certificate of a gain file."""
    add_gain(parser)


def export(parser: ArgumentParser) -> None:
    """Write the controller of a gain file for a real-time computer or another program."""
    add_gain(parser)
    _add_target(parser)
    types = ("double", "single")
    _add_form(parser, "c")
    text = "c: type of all numbers (default double)"
    add_option(parser, "--precision", types, text)
    text = "c: prefix of the C names (default: the output's name without its ending)"
    add_option(parser, "--name", str, text)
    add_option(parser, "--order", int, "dao: M of the RTC's configuration (default 20)")
    text = "c, cacao, dao, pyrtc: modes of the RTC (default: those of the design)"
    add_option(parser, "--modes", int, text)
    text = "the same: gain of an integrator for each further mode (default: no command)"
    add_option(parser, "--other-gain", float, text)
    text = "cacao: frames of history (default: as many as the loss needs)"
    add_option(parser, "--steps", int, text)
    text = "cacao: relative loss of residual that chooses them (default 0.01, the most)"
    add_option(parser, "--loss", float, text)
    text = "file to write: .c (the .h goes beside it), .mat, .fits or .npy, and its certificate; "
    text += "pyrtc: folder"
    add_output(parser, text)


def _add_form(parser: ArgumentParser, whose: str) -> None:
    text = "plain assumes that commands are applied, estimator is given those that were"
    add_option(parser, "--form", ("plain", "estimator"), f"{whose}: {text} (default plain)")


def rehearse(parser: ArgumentParser) -> None:
    """Run a gain file in the arithmetic of another program, in the loop, on a record."""
    add_gain(parser)
    _add_target(parser)
    text = "what a loop recorded (default: a disturbance drawn from the file's own truth)"
    add_option(parser, "--record", str, text, metavar="FILE", dest="file")
    add_missing_facts(parser)
    add_repairs(parser)
    add_option(parser, "--sensor-gain", float, "sensor gain of the record", 1.0)
    add_option(parser, "--stroke", float, "largest command that the mirror applies [nm]")
    add_option(parser, "--frames", int, "frames to draw where there is no record (default 8000)")
    add_option(parser, "--seed", int, "seed of what is drawn", 1)
    add_option(parser, "--wavelength-um", float, "of Strehl ratios (default: the file's, or 2.2)")
    add_output(parser, FIGURE, required=False)


def _add_target(parser: ArgumentParser) -> None:
    from lbt_synth.interop.target import target_names

    text = "the program that loads the file; without NAME, list what each computes, and end"
    add_option(
        parser,
        "--for",
        target_names(),
        text,
        action=TargetChoice,
        nargs="?",
        required=True,
        dest="target",
        metavar="NAME",
    )


def plot(parser: ArgumentParser) -> None:
    """Plot loops of one or several designs in a classical view, and print their margins."""
    add_unit(parser)
    text = (
        "sigma: largest singular values; bode: gain and phase over frequency; nyquist: loops in "
        "the complex plane; nichols: gain over phase; step: residual and command after a step"
    )
    add_option(parser, "kind", ("sigma", "bode", "nyquist", "nichols", "step"), text)
    add_gains(parser, "+")
    text = "real sensor gain, as a factor on the one that each design assumes"
    add_option(parser, "--sensor-gain", float, text, 1.0)
    add_outputs(parser)


def report(parser: ArgumentParser) -> None:
    """Write a page about designs in the loop of a configuration."""
    add_unit(parser)
    add_config(parser)
    add_gains(parser, "+")
    add_option(parser, "--title", str, "heading of the page (default: names the configuration)")
    add_option(parser, "--pdf", str, "write the same as a PDF, too (.pdf)", metavar="FILE")
    add_output(parser, "page to write, one file that opens offline (.html)")


def explore(parser: ArgumentParser) -> None:
    """Open a page of sliders in the browser, to see designs while the loop and the sky change."""
    add_unit(parser)
    add_config(parser)
    add_gains(parser, text="gain files to show beside the design of the sliders")
    text = "name or address to serve at (default localhost: this machine only; others can write "
    add_option(parser, "--host", str, text + "files with the page)")
    parser.set_defaults(host="localhost")
    add_option(parser, "--port", int, "port to serve at, 0 for any that is free", 5006)
    text = "host:port under which a browser reaches the page through a tunnel; repeatable"
    parser.add_argument("--origin", action="append", default=[], metavar="HOST:PORT", help=text)
    text = "directory that the page saves into (default: this one)"
    add_output(parser, text, required=False, default=".")


def simulate(parser: ArgumentParser) -> None:
    """Close the loop in the time domain, beside the exact answer."""
    add_unit(parser)
    add_config(parser)
    add_gain(parser)
    add_option(parser, "--frames", int, "frames to keep")
    add_option(parser, "--cases", int, "independent runs")
    add_option(parser, "--seed", int, "seed of the random series")
    add_option(parser, "--sensor-gain", float, "real sensor gain")
    add_faults(parser)
    _add_form(parser, "of the controller")
    add_output(parser, FIGURE, required=False)
    add_option(parser, "--telemetry", str, "write the first run (.fits, .npz)", metavar="FILE")


def telemetry(parser: ArgumentParser) -> None:
    """Show what a telemetry file holds, and write it in another format."""
    parser.add_argument("file", help="telemetry (.fits or .npz; FITS of the AOT standard, too)")
    add_unit(parser)
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
    add_unit(parser)
    add_config(parser)
    add_option(parser, "--pixels", int, "pixels across the pupil, even")
    add_option(parser, "--frames", int, "frames of an exposure")
    add_option(parser, "--settle-frames", int, "frames to settle before, at least 200")
    add_option(parser, "--seed", int, "seed of the random parts, the first of several")
    add_option(parser, "--cache", str, "directory for calibrations and phase screens")
    add_output(parser, "directory to write into")


def identify(parser: ArgumentParser) -> None:
    """Identify turbulence, vibrations, noise and sensor gain from a record."""
    add_record(parser)
    add_output(parser, "configuration to write (.yaml)")


def auto(parser: ArgumentParser) -> None:
    """Go from a record to a gain file: identify, design, certify, test on unseen data."""
    from lbt_synth.methods.registry import default_method, record_methods

    add_record(parser)
    text = (
        f"default: {default_method()}, unless another of the quick ones leaves clearly less of the "
        "frames after its training"
    )
    add_option(parser, "--method", record_methods(), text)
    text = "norm as a multiple of the least norm, for methods with a bound (default 1.2)"
    add_option(parser, "--gamma-ratio", float, text)
    add_option(parser, "--model", str, "configuration to write (default: the output's name, .yaml)")
    add_output(parser, GAIN_FILE)


def diagnose(parser: ArgumentParser) -> None:
    """Say what ran in a record, what is wrong, what it costs, and what to change first."""
    add_series(parser)
    parser.add_argument("gain", nargs="?", help=f"{GAIN_FILE} to try on the record")
    add_output(parser, "page to write, one file that opens offline (.html)", required=False)
    add_option(parser, "--pdf", str, "write the same as a PDF, too (.pdf)", metavar="FILE")


def robustness(parser: ArgumentParser) -> None:
    """Compute the Strehl ratio against an error of all vibration frequencies.

    It is that of filters redesigned at each error, or of the designs of gain files at many sensor
    gains.
    """
    add_unit(parser)
    add_config(parser)
    add_gains(parser)
    redesigned = parser.add_argument_group("without gain files")
    add_option(redesigned, "--gamma-ratio", float, "H-infinity bound of each row")
    add_option(redesigned, "--sensor-gain", float, "real sensor gain")
    fixed = parser.add_argument_group("with gain files")
    for name, text in (
        ("--errors-hz", "true frequency less that of the design, of the line that moves most [Hz]"),
        ("--sensor-gains", "real sensor gain"),
    ):
        text += ": COUNT values (default: the configuration's)"
        add_option(fixed, name, float, text, nargs=3, metavar=("LOW", "HIGH", "COUNT"))
    text = "real delay less that of the design [frames] (default: the configuration's, else 0)"
    name, dest = "--delay-errors", "delay_errors_frames"
    add_option(fixed, name, float, text, nargs="+", dest=dest, metavar="FRAMES")
    add_outputs(parser)


def tradeoff(parser: ArgumentParser) -> None:
    """Design filters from the least norm to the least variance, and compare their sensor gains."""
    add_unit(parser)
    add_config(parser)
    text = "levels of the norm, from the least of any filter to that of the Kalman filter, 2 to 200"
    add_option(parser, "--points", int, text, 9)
    text = "past innovations that the mixed filters (least variance at each norm) weigh, 1 to 64"
    add_option(parser, "--taps", int, text, 16)
    add_outputs(parser)


def limits(parser: ArgumentParser) -> None:
    """Show how far designs are from the least residual of any linear controller."""
    add_unit(parser)
    add_config(parser)
    add_gains(
        parser,
        text="gain files to add to the integrator, the Kalman and the H-infinity filter of the "
        "configuration",
    )
    add_outputs(parser)


def mirror(parser: ArgumentParser) -> None:
    """Show the step of the mirror's local loop, and what ignoring its dynamics costs."""
    add_unit(parser)
    add_config(parser)
    text = "half width of the band in which the mirror counts as settled"
    add_option(parser, "--tolerance", float, text, 0.1)
    add_outputs(parser)


def modal(parser: ArgumentParser) -> None:
    """Compare integrators, optimised gains and Kalman filters for all modes of the mirror."""
    add_unit(parser)
    add_config(parser)
    add_option(parser, "--modes", int, "number of modes, at least 2 (default: mirror.modes)")
    add_outputs(parser)


def study(parser: ArgumentParser) -> None:
    """Try controllers on many samples of what the loop may meet; resumes if started again."""
    add_unit(parser)
    parser.add_argument("study", metavar="file", help="study file (YAML)")
    add_output(parser, "directory of the study")
    add_engine(parser)
    add_switch(parser, "--pdf", "write the page as a PDF, too (summary.pdf)")
    instead = parser.add_mutually_exclusive_group()
    add_switch(instead, "--dry-run", "say how many samples and how long, and write nothing")
    add_option(instead, "--row", int, "recompute one row, and write it as a configuration")


def paper(parser: ArgumentParser) -> None:
    """Compute the tables and figures of Agapito et al. 2008, ours beside theirs."""
    add_unit(parser)
    add_output(parser, "directory to write into")


def help(parser: ArgumentParser) -> None:  # noqa: A001
    """Show what a command does, and its arguments."""
    parser.add_argument("topic", nargs="?", metavar="command", help="default: all of them")


def completion(parser: ArgumentParser) -> None:
    """Print the script with which a shell completes commands, options and files."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))
