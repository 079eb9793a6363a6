"""The arguments of each command, declared apart from what runs it so that help stays quick.

The docstring of a function that adds the arguments of a command is the help of the command.
"""

from __future__ import annotations

from argparse import Action, ArgumentParser, Namespace, _ActionsContainer
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from lbt_synth.storage.display_unit import M_S2, UNITS

if TYPE_CHECKING:  # slow to import for --help
    from pydantic.fields import FieldInfo

    from lbt_synth.methods.method import Method

_LIMITS = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
GAIN_FILE = "gain file (.fits or .npz)"
FIGURE = "figure (.png, .pdf or .svg)"
_SHARED: Mapping[str, dict[str, Any]] = {
    "config": {"help": "configuration file (YAML)"},
    "gain": {"help": GAIN_FILE},
    "--unit": {
        "choices": UNITS,
        "help": "what tables, figures and pages show wavefronts in (default nm; JSON and CSV stay "
        "in nm)",
    },
    "--output": {
        "action": "append",
        "default": [],
        "help": "table (.csv) or figure (.png, .pdf, .svg); repeatable",
    },
    "--pdf": {"metavar": "FILE", "help": "write the same as a PDF, too (.pdf)"},
    "--jobs": {"type": int, "default": 1, "help": "processes (default 1)"},
    "--stroke": {"type": float, "help": "largest command that the mirror applies [nm]"},
    "--wavelength-um": {"type": float, "help": "of Strehl ratios (default: the file's, or 2.2)"},
}


def add_shared(parser: _ActionsContainer, *names: str) -> None:
    """Add arguments that are the same in several commands."""
    for name in names:
        flags = ("-o", name) if name == "--output" else (name,)
        parser.add_argument(*flags, **_SHARED[name])


def add_option(
    parser: _ActionsContainer,
    name: str,
    kind: type[Any] | Sequence[str],
    text: str = "",
    default: float | None = None,
    **more: Any,
) -> None:
    """Add an option of a type or of some choices; its help ends with its default."""
    if default is not None:
        text += f" (default {default:g})"
    more |= {"type": kind} if isinstance(kind, type) else {"choices": kind}
    parser.add_argument(name, help=text, default=default, **more)


def add_switch(parser: _ActionsContainer, name: str, text: str) -> None:
    """Add an option without a value."""
    parser.add_argument(name, action="store_true", help=text)


def option_name(argument: str) -> str:
    """Return an option as people write it, by the name of its argument."""
    return f"--{argument.replace('_', '-')}"


def given_options(arguments: Namespace, *names: str) -> dict[str, Any]:
    """Return the options of those names that the command line gives."""
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def add_gains(parser: ArgumentParser, nargs: str = "*", text: str = GAIN_FILE) -> None:
    """Add gain files."""
    # without a default, argparse calls them required
    parser.add_argument("gains", nargs=nargs, metavar="gain", help=text, default=[])


def add_output(
    parser: ArgumentParser, text: str, *, required: bool = True, default: str | None = None
) -> None:
    """Add one output."""
    parser.add_argument("-o", "--output", required=required, default=default, help=text)


class TargetChoice(Action):
    """Take the name of a target; without one, print all of them and end."""

    def __call__(
        self, parser: ArgumentParser, namespace: Namespace, values: Any, option: Any = None
    ) -> None:
        """Store the name, or print how each target computes."""
        if values is not None:
            setattr(namespace, self.dest, values)
            return
        from lbt_synth.cli.output import Report  # needs what makes help slow
        from lbt_synth.interop import target_named
        from lbt_synth.interop.pipeline import target_names
        from lbt_synth.storage.rows import fact_table

        targets = {name: target_named(name) for name in target_names()}
        Report(
            tables=[
                fact_table(f"{name}: {target.file}", target.arithmetic)
                for name, target in targets.items()
            ]
        ).print(as_json=False)
        parser.exit()


def init(parser: ArgumentParser) -> None:
    """Write a commented configuration to begin with."""
    from lbt_synth.config.load import telescope_names

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
    add_shared(parser, "--unit", "config")
    _add_method_options(parser)
    add_output(parser, GAIN_FILE)


def _add_method_options(parser: ArgumentParser) -> None:
    """Add ``--method`` and the options of all methods; each method checks its own."""
    from lbt_synth.methods.registry import METHODS, option_names

    methods = METHODS
    parser.add_argument(
        "--method",
        choices=tuple(methods),
        required=True,
        help="; ".join(
            name if name == method.title else f"{name}: {method.title}"
            for name, method in methods.items()
        ),
    )
    for name in option_names():
        owners = [method for method in methods.values() if name in method.options.model_fields]
        helps: dict[str, list[str]] = {}
        for method in owners:
            helps.setdefault(_help_text(method, name), []).append(method.name)
        text = "; ".join(f"{', '.join(names)}: {text}" for text, names in helps.items())
        if others := sorted({o for m in owners if name in m.exclusive for o in m.exclusive}):
            text += f"; at most one of {', '.join(map(option_name, others))}"
        kinds = _kinds(owners[0].options.model_fields[name])
        words = dict.fromkeys(c for m in owners for c in _choices(m.options.model_fields[name]))
        parser.add_argument(
            option_name(name),
            type=next((kind for kind in (int, float) if kind in kinds), str),
            metavar=f"{{{','.join(words)}}}" if words else None,
            help=text.replace("%", "%%"),
        )


def _kinds(option: FieldInfo) -> tuple[Any, ...]:
    """Return the types of an option, one or those of a union."""
    if get_origin(option.annotation) is Literal:
        return (option.annotation,)
    return get_args(option.annotation) or (option.annotation,)


def _choices(option: FieldInfo) -> list[str]:
    return [c for kind in _kinds(option) if get_origin(kind) is Literal for c in get_args(kind)]


def _help_text(method: Method, name: str) -> str:
    """Return the description of an option with its choices or its range, and its default."""
    option = method.options.model_fields[name]
    choices = _choices(option)
    limits = {
        end: getattr(limit, end)
        for limit in option.metadata
        for end in _LIMITS
        if getattr(limit, end, None) is not None
    }
    text = option.description or ""
    if choices and not all(choice in text for choice in choices):
        text += f", {' or '.join(choices)}"
    if limits:
        text += f", {' and '.join(f'{_LIMITS[end]} {limit:g}' for end, limit in limits.items())}"
    if option.is_required() or option.default is None:
        return text
    if name in method.configurable:
        return f"{text} (default: the configuration's, else {option.default:g})"
    return f"{text} (default {option.default})"


def show(parser: ArgumentParser) -> None:
    """Show a gain file: design, loop, margins, certificate."""
    add_shared(parser, "--unit", "gain")
    add_switch(parser, "--matrices", "print the gains and the controller")


def verify(parser: ArgumentParser) -> None:
    """Recompute the certificate of a gain file."""
    add_shared(parser, "gain")


def export(parser: ArgumentParser) -> None:
    """Write the controller of a gain file for a real-time computer or another program."""
    add_shared(parser, "gain")
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
    add_shared(parser, "gain")
    _add_target(parser)
    text = "what a loop recorded (default: a disturbance drawn from the file's own truth)"
    add_option(parser, "--record", str, text, metavar="FILE", dest="file")
    _add_reading(parser)
    add_shared(parser, "--stroke")
    add_option(parser, "--frames", int, "frames to draw where there is no record (default 8000)")
    add_option(parser, "--seed", int, "seed of what is drawn", 1)
    add_shared(parser, "--wavelength-um")
    add_output(parser, FIGURE, required=False)


def _add_target(parser: ArgumentParser) -> None:
    from lbt_synth.interop.pipeline import target_names

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
    add_shared(parser, "--unit")
    text = (
        "sigma: largest singular values; bode: gain and phase over frequency; nyquist: loops in "
        "the complex plane; nichols: gain over phase; step: residual and command after a step"
    )
    add_option(parser, "kind", ("sigma", "bode", "nyquist", "nichols", "step"), text)
    add_gains(parser, "+")
    text = "factor on the sensor gain that each design assumes, at which the loops are closed"
    add_option(parser, "--gain-factor", float, text, 1.0)
    add_shared(parser, "--output")


def report(parser: ArgumentParser) -> None:
    """Write a page about designs in the loop of a configuration."""
    add_shared(parser, "--unit", "config")
    add_gains(parser, "+")
    add_option(parser, "--title", str, "heading of the page (default: names the configuration)")
    add_shared(parser, "--pdf")
    add_output(parser, "page to write, one file that opens offline (.html)")


def explore(parser: ArgumentParser) -> None:
    """Open a page of sliders in the browser, to see designs while the loop and the sky change."""
    add_shared(parser, "--unit", "config")
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
    add_shared(parser, "--unit", "config", "gain")
    add_option(parser, "--frames", int, "frames to keep")
    add_option(parser, "--cases", int, "independent runs")
    add_option(parser, "--seed", int, "seed of the random series")
    add_option(parser, "--sensor-gain", float, "real sensor gain")
    add_shared(parser, "--stroke")
    parser.add_argument(
        "--drop",
        action="append",
        metavar="SENSOR@START[..END][:READING]",
        help="a sensor or channel that fails [s], as in m2@10s or wavefront@20s..20.2s; READING "
        "missing (seen, default), zero or frozen (believed)",
    )
    _add_form(parser, "of the controller")
    add_output(parser, FIGURE, required=False)
    add_option(parser, "--telemetry", str, "write the first run (.fits, .npz)", metavar="FILE")


def telemetry(parser: ArgumentParser) -> None:
    """Show what a telemetry file or a record holds, and write it as telemetry."""
    parser.add_argument("file", help="telemetry, or a record of series (FITS, NPY, NPZ or CSV)")
    _add_reading(parser)
    add_output(parser, "file to write (.fits, .npz or .aot.fits)", required=False)
    endings = ("fits", "npz", "aot")
    add_option(parser, "--format", endings, "of the file to write (default: its ending)")
    types = ("float64", "float32")
    add_option(parser, "--precision", types, "of the series written (default float64)")


def end_to_end(parser: ArgumentParser) -> None:
    """Close the loop end to end: pyramid, mirror and moving air."""
    _add_simulator(parser)
    add_shared(parser, "gain")


def end_to_end_table(parser: ArgumentParser) -> None:
    """Run Tables II and III of Agapito et al. 2008 end to end."""
    _add_simulator(parser)
    add_gains(parser, text="gain files to run beside the paper's filters")
    add_shared(parser, "--jobs")
    add_option(parser, "--seeds", int, "seeds of Table II and of 20 Hz", 3)
    add_option(parser, "--row-seeds", int, "seeds of the other rows", 1)
    parser.add_argument(
        "--tables", nargs="+", choices=("II", "III"), default=["II", "III"], help="default both"
    )


def _add_simulator(parser: ArgumentParser) -> None:
    add_shared(parser, "--unit", "config")
    add_option(parser, "--pixels", int, "pixels across the pupil, even")
    add_option(parser, "--frames", int, "frames of an exposure")
    add_option(parser, "--settle-frames", int, "frames to settle before, at least 200")
    add_option(parser, "--seed", int, "seed of the random parts, the first of several")
    add_option(parser, "--cache", str, "directory for calibrations and phase screens")
    add_output(parser, "directory to write into")


def _add_reading(parser: ArgumentParser) -> None:
    """Add what a record's file may not say, and what its commands need."""
    facts = parser.add_argument_group(
        "reading the record",
        "What its file does not say, and what its commands need, in this order, to be those that "
        "the mirror followed. The telemetry that lbt-synth telemetry -o writes says all of it.",
    )
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
    text = "columns by name or number from 0, as in measurements=tip,tilt commands=3,4 times="
    add_option(facts, "--columns", str, text, nargs="+", metavar="ROLE=NAME")
    add_option(facts, "--axes", int, "which of several columns or modes, from 0", nargs="+")
    text = "sensor gain that is known, of both axes or of each"
    add_option(facts, "--sensor-gain", float, text, nargs="+")
    add_switch(facts, "--command-increments", "the commands are increments: add them up")
    text = "frames by which the commands move to later frames, or to earlier ones below 0"
    add_option(facts, "--command-shift-frames", int, text, 0)
    add_switch(facts, "--swap-axes", "exchange the commands of the two axes")
    text = "1 or -1 on the commands, of both axes or of each"
    add_option(facts, "--command-sign", int, text, nargs="+")
    text = "matrix from the commands to the axes of the measurements, row after row"
    add_option(facts, "--command-matrix", float, text, nargs="+", metavar="NUMBER")
    text = "factor on the commands, of both axes or of each; 1 says that they were recorded as "
    add_option(facts, "--command-scale", float, text + "large as applied", nargs="+")


def _add_prior_knowledge(parser: ArgumentParser) -> None:
    """Add what is known before an identification."""
    known = parser.add_argument_group("what is known beforehand")
    text = "noise per frame of the loop's sensor [nm], beside a spectrum that has none"
    add_option(known, "--noise-nm", float, text, nargs="+")
    add_option(known, "--lines-hz", float, "frequencies of vibrations [Hz]", nargs="+")
    add_option(known, "--lines-error-hz", float, "standard error of --lines-hz [Hz]", 0.1)
    add_option(known, "--lines-file", str, "text file with one frequency per row [Hz]")
    add_option(known, "--lowest-line-hz", float, "what is below counts as turbulence [Hz]", 3.0)
    add_option(known, "--most-lines", int, "most vibrations per axis", 20)


def _add_series(parser: ArgumentParser) -> None:
    """Add a record, or a series, and all that it may not say."""
    parser.add_argument(
        "file",
        help="what the loop recorded: telemetry, or FITS, NPY, NPZ or CSV with measurements "
        "and commands, or an open-loop series (identify: or a spectrum)",
    )
    _add_reading(parser)
    _add_prior_knowledge(parser)
    add_shared(parser, "--wavelength-um")


def _add_record(parser: ArgumentParser) -> None:
    """Add a record that is fitted, and its figure."""
    _add_series(parser)
    text = "go on although the commands do not reach the measurements as given"
    add_switch(parser, "--accept-record", text)
    add_option(parser, "--figure", str, "figure to write (default: the output's name, .png)")
    add_switch(parser, "--no-figure", "write no figure")


def identify(parser: ArgumentParser) -> None:
    """Identify turbulence, vibrations, noise and sensor gain from a record."""
    _add_record(parser)
    _add_accelerometers(parser)
    add_output(parser, "configuration to write (.yaml)")


def _add_accelerometers(parser: ArgumentParser) -> None:
    """Add accelerometers beside a record."""
    moving = parser.add_argument_group("accelerometers")
    text = "NPY or CSV with one column per channel and one row per frame of the record"
    add_option(moving, "--accelerometers", str, text)
    text = "their rate (default: that of the file's times or header, else the frame rate) [Hz]"
    add_option(moving, "--accelerometer-rate-hz", float, text)
    text = f"their unit: {', '.join(M_S2)} (default: that of the headings, else m/s2)"
    add_option(moving, "--acceleration-unit", tuple(M_S2), text, metavar="UNIT")


def auto(parser: ArgumentParser) -> None:
    """Go from a record to a gain file: identify, design, certify, test on unseen data."""
    from lbt_synth.methods.registry import default_method, record_methods

    _add_record(parser)
    _add_accelerometers(parser)
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
    _add_series(parser)
    parser.add_argument("gain", nargs="?", help=f"{GAIN_FILE} to try on the record")
    add_output(parser, "page to write, one file that opens offline (.html)", required=False)
    add_shared(parser, "--pdf")


def robustness(parser: ArgumentParser) -> None:
    """Compute the Strehl ratio against an error of all vibration frequencies.

    It is that of filters redesigned at each error, or of the designs of gain files at many sensor
    gains.
    """
    add_shared(parser, "--unit", "config")
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
    add_shared(parser, "--output")


def tradeoff(parser: ArgumentParser) -> None:
    """Design filters from the least norm to the least variance, and compare their sensor gains."""
    add_shared(parser, "--unit", "config")
    text = "levels of the norm, at least 2, from the least of any filter to the Kalman filter's"
    add_option(parser, "--points", int, text, 9)
    text = "past innovations that the mixed filters (least variance at each norm) weigh, 1 to 64"
    add_option(parser, "--taps", int, text, 16)
    add_shared(parser, "--output")


def limits(parser: ArgumentParser) -> None:
    """Show how far designs are from the least residual of any linear controller."""
    add_shared(parser, "--unit", "config")
    add_gains(
        parser,
        text="gain files to add to the integrator, the Kalman and the H-infinity filter of the "
        "configuration",
    )
    add_shared(parser, "--output")


def mirror(parser: ArgumentParser) -> None:
    """Show the step of the mirror's local loop, and what ignoring its dynamics costs."""
    add_shared(parser, "--unit", "config")
    text = "half width of the band in which the mirror counts as settled"
    add_option(parser, "--tolerance", float, text, 0.1)
    add_shared(parser, "--output")


def modal(parser: ArgumentParser) -> None:
    """Compare integrators, optimised gains and Kalman filters for all modes of the mirror."""
    add_shared(parser, "--unit", "config")
    add_option(parser, "--modes", int, "number of modes, at least 2 (default: mirror.modes)")
    add_shared(parser, "--output")


def study(parser: ArgumentParser) -> None:
    """Try controllers on many samples of what the loop may meet; resumes if started again."""
    add_shared(parser, "--unit")
    parser.add_argument("study", metavar="file", help="study file (YAML)")
    add_output(parser, "directory of the study")
    engine = parser.add_mutually_exclusive_group()
    add_shared(engine, "--jobs")
    text = "Dask scheduler that runs it instead, as tcp://host:8786; it can run code here: trust it"
    add_option(engine, "--dask", str, text, metavar="ADDRESS")
    text = "files of the authority, certificate and key for a scheduler at tls://host:8786"
    metavar = ("CA", "CERT", "KEY")
    add_option(parser, "--dask-tls", str, text, nargs=3, metavar=metavar)
    add_switch(parser, "--pdf", "write the page as a PDF, too (summary.pdf)")
    instead = parser.add_mutually_exclusive_group()
    add_switch(instead, "--dry-run", "say how many samples and how long, and write nothing")
    add_option(instead, "--row", int, "recompute one row, and write it as a configuration")


def paper(parser: ArgumentParser) -> None:
    """Compute the tables and figures of Agapito et al. 2008, ours beside theirs."""
    add_shared(parser, "--unit")
    add_output(parser, "directory to write into")


def completion(parser: ArgumentParser) -> None:
    """Print the script with which a shell completes commands, options and files."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))
