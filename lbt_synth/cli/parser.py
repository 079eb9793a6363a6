"""The parser of the command line: every command, its help and its arguments."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import lbt_synth
from lbt_synth.cli.arguments import designs, loops, records, shared, studies

# In the order of the help. A command runs in the module of its name, with underscores for dashes.
COMMANDS: dict[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    "design": ("Design a controller and write its gain file", designs.add_design),
    "show": ("Show a gain file: design, loop, margins, certificate", designs.add_show),
    "verify": ("Recompute the certificate of a gain file", shared.add_gain),
    "export": (
        "Write the controller of a gain file for a real-time computer or another program",
        designs.add_export,
    ),
    "sigma": ("Plot singular values of one or several designs", designs.add_sigma),
    "simulate": (
        "Close the loop in the time domain, beside the exact answer",
        loops.add_simulate,
    ),
    "telemetry": (
        "Show what a telemetry file holds, and write it in another format",
        loops.add_telemetry,
    ),
    "identify": (
        "Identify turbulence, vibrations, noise and sensor gain from a record",
        records.add_identify,
    ),
    "auto": (
        "From a record to a gain file: identify, design, certify, test on unseen data",
        records.add_auto,
    ),
    "robustness": (
        "Strehl ratio against an error of all vibration frequencies: of filters redesigned at "
        "each error, or of the designs of gain files at many sensor gains",
        studies.add_robustness,
    ),
    "tradeoff": (
        "Filters from the least norm to the least variance, and their sensor gains",
        studies.add_tradeoff,
    ),
    "limits": (
        "How far designs are from the least residual of any linear controller",
        studies.add_limits,
    ),
    "report": ("Write a page about designs in the loop of a configuration", designs.add_report),
    "end-to-end": (
        "Close the loop end to end: pyramid, mirror and moving air",
        loops.add_end_to_end,
    ),
    "end-to-end-table": (
        "Tables II and III of Agapito et al. 2008 end to end",
        loops.add_end_to_end_table,
    ),
    "mirror": (
        "The mirror's local loop: its step, and what ignoring its dynamics costs",
        studies.add_mirror,
    ),
    "modal": (
        "Integrators, optimised gains and Kalman filters for all modes of the mirror",
        studies.add_modal,
    ),
    "study": (
        "Try controllers on many samples of what the loop may meet; resumes if started again",
        studies.add_study,
    ),
    "paper": ("Tables and figures of Agapito et al. 2008, ours beside theirs", studies.add_paper),
}


def build_parser(named: str = "") -> argparse.ArgumentParser:
    """Build the parser of all commands, with the arguments of the command that is named."""
    parser = argparse.ArgumentParser(
        prog="lbt-synth",
        description="Design, certify and analyse tip/tilt controllers that reject vibrations.",
        epilog="Exit status: 0 done, 1 a design or verification failed, 2 wrong usage or input.",
    )
    parser.add_argument("--version", action="version", version=f"lbt-synth {lbt_synth.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (text, add_arguments) in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=f"{text}.")
        command.add_argument("--json", action="store_true", help="print one JSON object instead")
        if name == named:
            add_arguments(command)
    return parser
