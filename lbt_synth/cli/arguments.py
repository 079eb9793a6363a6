"""All commands with their arguments, in one table, and the parser that is made from it.

The table is apart from what runs the commands so that help stays quick. With an indent of two
stands a command, the module that runs it and its help, and with an indent of four an argument: its
flags, how it is read, and its help, between bars. A deeper line goes on with the one before. An
argument is read as a type, a default (``=``), ``nargs:``, ``meta:`` and ``dest:`` as in argparse,
``repeat`` for values of an option that is given again, and ``/`` or ``@`` for choices. Names
without bars are blocks that commands share. A line that begins with ``>`` opens a group of
arguments; those of ``> one of`` exclude each other, and ``>`` alone ends it.
"""

from __future__ import annotations

import argparse
import importlib
import re
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from textwrap import wrap
from typing import Any, NamedTuple, NoReturn, cast

import lbt_synth
from lbt_synth.cli.streams import printable
from lbt_synth.errors import ProblemError
from lbt_synth.storage.display_unit import M_S2, UNITS

_SHARED = """
  config | config | | configuration file (YAML)
  gain | gain | | gain file (.fits or .npz)
  gains | gains | nargs:* meta:gain | gain files (.fits or .npz)
  gains+ | gains | nargs:+ meta:gain | gain files (.fits or .npz)
  unit | --unit | @units | of wavefronts (default: the file's, else nm; JSON has nm)
  outputs | -o --output | repeat | table (.csv) or figure (.png, .pdf, .svg); repeatable
  pdf | --pdf | meta:FILE | write the same as a PDF, too (.pdf)
  jobs | --jobs | int =1 | processes
  stroke | --stroke | float | largest command that the mirror applies [nm]
  wavelength | --wavelength-um | float | of Strehl ratios (default: the file's, or 2.2)
  target | --for | @targets dest:target required | the program that loads the file
  reading
    > reading the record: what its file does not say, and what its commands need, in this order,
        to be those that the mirror followed; what lbt-synth telemetry -o writes says all of it
    --frame-rate-hz | float | frame rate [Hz]
    --delay-frames | float | total delay [frames]
    --unit | | of the measurements: nm, um, m, mas, arcsec, urad, rad
    --show-unit | @units | of what is shown (default: the record's; JSON and CSV stay in nm)
    --command-unit | | of the commands (default: --unit)
    --diameter-m | float | telescope diameter [m], for angles
    --obstruction | float | as a fraction of the diameter
    --averages | int | periodograms that a spectrum is the mean of
    --commands | | another file, with the commands
    --columns | nargs:+ meta:ROLE=NAME | by name or number, as measurements=tip,tilt times= or
        open_loop=0,1
    --loop | | of the control loops of an AOT file, by name or number from 0 (default: the first)
    --axes | int nargs:+ | which of several columns or modes, from 0
    --sensor-gain | float nargs:+ | sensor gain that is known, of both axes or of each
    --command-increments | switch | they are increments: add them up
    --command-shift-frames | int =0 | frames by which they move to later frames
    --swap-axes | switch | exchange those of the two axes
    --command-sign | int nargs:+ | 1 or -1, of both axes or of each
    --command-matrix | float nargs:+ meta:NUMBER | to the axes of the measurements, row after row
    --command-scale | float nargs:+ | factor, of both axes or of each; 1: as large as applied
  series
    file | | telemetry, or FITS, NPY, NPZ, CSV, HDF5, MATLAB or IDL with what a loop measured and
        commanded, or an open-loop series (identify: or a spectrum)
    known
  known
    reading
    > what is known beforehand
    --noise-nm | float nargs:+ | noise per frame of the sensor [nm], beside a spectrum without
    --lowest-line-hz | float =3 | what is below counts as turbulence [Hz]
    --most-lines | int =20 | most vibrations per axis
    >
    wavelength
  judged
    --accept-record | switch | go on although the commands do not reach the measurements as given
    --no-figure | switch | write no figure beside the output (.png)
  accelerometers
    > accelerometers
    --accelerometers | | NPY or CSV with one column per channel and one row per frame of the record
    --accelerometer-rate-hz | float | their rate [Hz] (default: the file's, or the frame rate)
    --acceleration-unit | @accelerations meta:UNIT | m/s2, mm/s2, um/s2, g, mg (default: of
        the headings, else m/s2)
"""
_TABLE = """
  init | init | Write a commented configuration to begin with, and its schema.
    --telescope | @telescopes =generic | published numbers and their sources (default generic:
        assumed ones)
    --examples | switch | write the examples of the documentation instead (folder)
    --force | switch | replace files that are there
    -o --output | | file to write (default: the telescope, .yaml)
  design | design | Design a controller and write its gain file.
    unit config method
    -o --output | required | gain file (.fits or .npz)
  compare | comparisons | Compare gain files in the loop of a configuration, one line each.
    unit config gains+ outputs
  plot | pages | Plot loops of one or several designs in a classical view, and print their margins.
    unit
    kind | sigma/bode/nyquist/nichols/step | the view: sigma has the largest singular values,
        step the residual and the command after a step
    gains+
    --gain-factor | float =1 | factor on the sensor gain that each design assumes
    outputs
  simulate | simulate | Close the loop in the time domain, beside the exact answer.
    unit config gains+
    --frames | int | frames to keep
    --cases | int | independent runs
    --seed | int | seed of the random series
    --sensor-gain | float | real sensor gain
    stroke
    --drop | repeat meta:SENSOR@START[..END][:READING] | a sensor or channel that fails [s], as in
        m2@10s or wavefront@20s..20.2s; READING missing (seen, default), zero or frozen (believed)
    --form | plain/estimator | of the controller: plain assumes that commands are applied, estimator
        is given those that were (default plain)
    outputs
    --telemetry | meta:FILE | write the first run (.fits, .npz)
    --spectrum | meta:FILE | write the spectrum of the exact residual, as TIPTOP reads it (.fits)
  report | pages | Write a page about designs in the loop of a configuration.
    unit config gains+
    --title | | heading of the page (default: names the configuration)
    pdf
    -o --output | required | page to write, one file that opens offline (.html)
  explore | pages | Open a page of sliders in the browser, beside designs.
    unit config gains
    --host | =localhost | to serve at (default localhost: this machine only; others can write files)
    --port | int =5006 | port to serve at, 0 for any that is free
    --origin | repeat meta:HOST:PORT | under which a tunnel reaches the page; repeatable
    -o --output | =. | directory that the page saves into (default: this one)
  limits | comparisons | Show how far designs are from the least residual of any linear controller.
    unit config gains
    --frame-rates | float nargs:2 meta:LOW,HIGH | instead over the frame rate [Hz], for the file's
        star: integrator, Kalman filter and limit
    outputs
  robustness | comparisons | Map the Strehl ratio of gain files over an error of all vibration
        frequencies, the sensor gain and the delay.
    unit config gains+
    --errors-hz | float nargs:3 meta:LOW,HIGH,COUNT | true frequency less that of the design, of the
        line that moves most [Hz]: COUNT values (default: the configuration's)
    --sensor-gains | float nargs:3 meta:LOW,HIGH,COUNT | real sensor gain: COUNT values (default:
        the configuration's)
    --delay-errors | float nargs:+ meta:FRAMES dest:delay_errors_frames | real delay less that of
        the configuration [frames] (default: the configuration's, else 0)
    outputs
  tradeoff | comparisons | Design filters from the least norm to the least variance.
    unit config
    --points | int =9 | levels of the norm, at least 2, from the least to the Kalman filter's
    --taps | int =16 | past innovations that the mixed filters weigh, 1 to 64
    outputs
  study | study | Try controllers on many samples of what the loop may meet; resumes.
    unit
    study | meta:file | study file (YAML)
    -o --output | required | directory of the study
    > one of
    jobs
    --dask | meta:ADDRESS | Dask scheduler, as tcp://host:8786; it can run code here: trust it
    >
    --pdf | switch | write the page as a PDF, too (summary.pdf)
    --row | int | recompute one row, and write it as a configuration
  modal | comparisons | Compare integrators, optimised gains and Kalman filters for all modes.
    unit config
    --modes | int | number of modes, at least 2 (default: mirror.modes)
    outputs
  show | design | Show a gain file: design, loop, margins, certificate.
    unit gain
  verify | design | Recompute the certificate of a gain file.
    gain
  telemetry | telemetry | Show what telemetry or a record holds, and write it as telemetry.
    file | | telemetry, or a record of series (FITS, CSV, HDF5 and others)
    reading
    >
    -o --output | | file to write (.fits, .npz or .aot.fits)
  identify | records | Identify turbulence, vibrations, noise and sensor gain from a record.
    series judged accelerometers
    >
    -o --output | required | configuration to write (.yaml)
  auto | records | Go from a record to a gain file: identify, design, certify, test on unseen data.
    files | nargs:+ meta:file | a record, as of identify, or one of each of several nights for one
        design that serves all of them
    known judged accelerometers
    >
    --method | @record_methods | default: kalman, unless another quick one leaves less
    --separate-axes | switch | no axis reads the other, for one filter per mode (dao)
    -o --output | required | gain file (.fits or .npz); the configuration of one record goes beside
        it (.yaml)
  diagnose | records | Say what ran in a record, what is wrong, what it costs, and what to change.
    series
    gain | nargs:? | gain file (.fits or .npz) to try on the record
    -o --output | | page to write, one file that opens offline (.html)
    pdf
  export | targets | Write the controller of a gain file for a real-time computer.
    gain target
    --form | plain/estimator | c: as of simulate (default plain)
    --precision | double/single | c: type of all numbers (default double)
    --name | | c: prefix of the C names (default: the output's name without its ending)
    --order | int | dao: M of the RTC's configuration (default 20, or what the design needs)
    --modes | int | c, cacao, dao, pyrtc: modes of the RTC (default: those of the design)
    --other-gain | float | gain of an integrator for each further mode (default: none)
    --steps | int | cacao: frames of history (default: as many as the proof needs)
    -o --output | required | file to write: .c (the .h goes beside it), .mat, .fits or .npy, and its
        certificate; pyrtc: folder
  rehearse | targets | Run a gain file in the arithmetic of another program, in the loop.
    file | meta:record | what a loop recorded
    gain target reading
    >
    stroke wavelength outputs
  paper | paper | Compute the tables and figures of Agapito et al. 2008, ours beside theirs.
    unit
    -o --output | required | directory to write into
  end-to-end | paper | Close the loop end to end: pyramid, mirror and moving air.
    unit config
    gains | nargs:* meta:gain | the gain file to run, or several beside the paper's filters
    --pixels | int | pixels across the pupil, even
    --frames | int | frames of an exposure
    --settle-frames | int | frames to settle before, at least 200
    --seed | int | seed of the random parts, the first of several
    -o --output | required | directory to write into
    > for tables of the paper
    --tables | II/III nargs:+ | run these tables of the paper instead of one gain file
    jobs
    --seeds | int =3 | seeds of Table II and of 20 Hz
    --row-seeds | int =1 | seeds of the other rows
  mirror | comparisons | Show how the mirror settles, and what ignoring its dynamics costs.
    unit config
    --tolerance | float =0.1 | half width of the band in which the mirror counts as settled
    outputs
"""


class Command(NamedTuple):
    """A command: the module that runs it, its help, and its arguments."""

    module: str
    text: str
    arguments: Sequence[str]


def _blocks(table: str) -> Iterator[tuple[str, list[str]]]:
    """Yield what is indented by two, each with the lines that are indented by four."""
    lines = re.sub(r"\n {8,}", " ", table).strip("\n")  # deeper lines go on
    for block in re.split(r"\n(?!    )", lines):
        title, *arguments = block.split("\n")
        yield title.strip(), [argument.strip() for argument in arguments]


_BLOCKS = {
    title.split()[0]: [title.partition(" | ")[2]] if "|" in title else arguments
    for title, arguments in _blocks(_SHARED)
}
COMMANDS = {
    name: Command(module, text, arguments)
    for title, arguments in _blocks(_TABLE)
    for name, module, text in (title.split(" | "),)
}
_GROUPS = {  # by the first command of each
    "init": "start: a configuration to begin with",
    "design": "design: from a configuration to a gain file",
    "compare": "look: what a design does in the loop, and what could be better",
    "show": "prove: what a gain file holds, and whether it is true",
    "telemetry": "records: from what a loop recorded to a model and a design",
    "export": "at the telescope: a gain file in another program",
    "paper": "the paper and the simulator: Agapito et al. 2008, a pyramid, and a slow mirror",
}
_CHOICES = {  # what an argument may be: a tuple, or the function that returns it, slow to import
    "units": UNITS,
    "accelerations": tuple(M_S2),
    "targets": "lbt_synth.interop.pipeline:target_names",
    "telescopes": "lbt_synth.config.load:telescope_names",
    "record_methods": "lbt_synth.methods.registry:record_methods",
}
_WORDS: Mapping[str, dict[str, Any]] = {  # how an argument is read, and what argparse is given
    "int": {"type": int},
    "float": {"type": float},
    "switch": {"action": "store_true"},
    "repeat": {"action": "append", "default": []},
    "required": {"required": True},
}
# how scripts of shtab complete names of files
_FILES = {"bash": "_shtab_compgen_files", "zsh": "_files", "fish": "(__fish_complete_path)"}


def _add_arguments(parser: ArgumentParser, rows: Sequence[str]) -> None:
    """Add the arguments of a command or of a block."""
    place: Any = parser
    for row in rows:
        if row.startswith(">"):
            title, _, text = row[1:].strip().partition(": ")
            if title == "one of":
                place = parser.add_mutually_exclusive_group()
            else:
                place = parser.add_argument_group(title, text or None) if title else parser
        elif "|" in row:
            flags, how, text = (cell.strip() for cell in f"{row} | ".split("|", 2))
            action = place.add_argument(*flags.split(), **_keywords(how, text.rstrip(" |")))
            if action.choices is None and action.nargs != 0 and action.type is None:
                action.complete = _FILES
        else:
            for name in row.split():
                if name == "method":
                    _add_method_options(parser)
                else:
                    _add_arguments(place, _BLOCKS[name])


def _keywords(how: str, text: str) -> dict[str, Any]:
    """Return what argparse is given for an argument."""
    keywords: dict[str, Any] = {"help": text}
    default = None
    for word in how.split():
        key, _, value = word.partition(":")
        if word in _WORDS:
            keywords |= _WORDS[word]
        elif word.startswith("="):
            default = word[1:]
        elif word.startswith("@"):
            choices = _CHOICES[word[1:]]
            if isinstance(choices, str):
                module, function = choices.split(":")
                choices = getattr(importlib.import_module(module), function)()
            keywords["choices"] = choices
        elif key == "nargs":
            keywords["nargs"] = int(value) if value.isdecimal() else value
            if value == "*":  # without a default, argparse calls them required
                keywords["default"] = []
        elif key == "meta":
            names = tuple(value.split(","))
            keywords["metavar"] = names if len(names) > 1 else value
        elif key == "dest":
            keywords["dest"] = value
        else:
            keywords["choices"] = tuple(word.split("/"))
    if default is not None:
        keywords["default"] = keywords.get("type", str)(default)
        if "type" in keywords:
            keywords["help"] += f" (default {default})"
    return keywords


def given_options(arguments: Namespace, *names: str) -> dict[str, Any]:
    """Return the options of those names that the command line gives."""
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def input_files(arguments: Namespace) -> tuple[str, ...]:
    """Return the files that the command line gives to be read, which no output may replace."""
    names = ("config", "file", "gain", "commands", "accelerometers")
    alone = [getattr(arguments, name, None) for name in names]
    several = [*getattr(arguments, "gains", ()), *getattr(arguments, "files", ())]
    return tuple(path for path in (*alone, *several) if isinstance(path, str))  # --gain is none


def _add_method_options(parser: ArgumentParser) -> None:
    """Add ``--method`` and the options of all methods; each method checks its own."""
    from lbt_synth.methods.registry import METHODS, option_names

    def designed(name: str) -> str:
        if name in METHODS and METHODS[name].of_record:
            raise argparse.ArgumentTypeError(
                f"{name} is made of a record, and not of a configuration alone. Try lbt-synth auto "
                f"RECORD --method {name}"
            )
        return name

    choices = [name for name, method in METHODS.items() if not method.of_record]
    titles = "; ".join(f"{name}: {METHODS[name].title}" for name in choices)
    parser.add_argument("--method", type=designed, choices=choices, required=True, help=titles)
    for name in option_names():
        owners: dict[str, list[str]] = {}
        for method in METHODS.values():
            if (option := method.options.model_fields.get(name)) is not None:
                help_text = option.description or ""
                if option.default is not None and not option.is_required():
                    usual = "the configuration's, else " * (name in method.configurable)
                    help_text += f" (default {usual}{option.default})"
                owners.setdefault(help_text, []).append(method.name)
        help_text = "; ".join(f"{', '.join(names)}: {said}" for said, names in owners.items())
        flag, help_text = f"--{name.replace('_', '-')}", help_text.replace("%", "%%")
        parser.add_argument(flag, type=_option_value, help=help_text)


def _option_value(word: str) -> int | float | str:
    """Return a number where a word is one; the method says what else it takes."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(word)
    return word


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line: what is wrong, and where help is."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the words, without control characters; exit with status 2."""
        self.exit(2, f"{self.prog}: error: {printable(message)} (see {self.prog} --help)\n")


def build_parser(named: str | None = None) -> argparse.ArgumentParser:
    """Build the parser of all commands, with the arguments of one, or of all for completions."""
    parser = Parser(
        prog="lbt-synth",
        description="Design, certify and analyse tip/tilt controllers that reject vibrations.",
        epilog=f"{_list_commands()}\n\nExit status: 0 done, 1 a design or verification failed, 2 "
        "wrong usage or input.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"lbt-synth {lbt_synth.__version__}")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, help="one of those below"
    )
    for name, command in COMMANDS.items():
        # completions have the commands with a help; the groups list them for everybody else
        listed: dict[str, Any] = {"help": command.text} if named is None else {}
        added = commands.add_parser(name, description=command.text, **listed)
        added.add_argument("--json", action="store_true", help="print one JSON object instead")
        added.add_argument("--verbose", action="store_true", help="print all tables and notes")
        if named in (None, name):
            _add_arguments(added, command.arguments)
    return parser


def _list_commands() -> str:
    lines = list[str]()
    for name, command in COMMANDS.items():
        lines += ["", _GROUPS[name]] if name in _GROUPS else []
        first, rest = f"  {name:14}", " " * 16
        lines += wrap(command.text.rstrip("."), 80, initial_indent=first, subsequent_indent=rest)
    return "\n".join(lines[1:])


def refuse_options(arguments: Namespace, names: Iterable[str], why: str) -> None:
    """Refuse options that the command line gives, although they do not go with the rest of it."""
    options = command_options(arguments.command)
    for name in names:
        option, usual = options[name]
        if getattr(arguments, name) != usual:
            raise ProblemError(f"{option} {why}.")


def command_options(name: str) -> dict[str, tuple[str, Any]]:
    """Return the longest spelling and the default of each option of a command, by its argument."""
    commands = build_parser(name)._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    actions = cast(dict[str, argparse.ArgumentParser], commands)[name]._actions
    return {
        action.dest: (max(action.option_strings, key=len), action.default)
        for action in actions
        if action.option_strings and action.dest != "help"
    }
