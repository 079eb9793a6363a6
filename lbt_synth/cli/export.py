"""The command export: a gain file in the form that another program loads."""

from __future__ import annotations

import math
from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.argument_kinds import given_options, option_name
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.errors import GainFileError, ProblemError
from lbt_synth.files import load_gain
from lbt_synth.interop import frame_cost, target_named
from lbt_synth.interop.export_checks import Exported
from lbt_synth.interop.target import CERTIFICATE, target_names
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import fact, fact_table, facts, json_record

_SINGLE_SUFFICES = 1e-3  # of the largest command
_OPTIONS = ("form", "precision", "name", "order", "modes", "other_gain", "steps", "loss")


def run(arguments: Namespace) -> Report:
    """Write the controller of a gain file for another program."""
    target = target_named(arguments.target)
    options = given_options(arguments, *_OPTIONS)
    for option in options:
        if option not in target.options:
            *some, last = (n for n in target_names() if option in target_named(n).options)
            fitting = f"{', '.join(some)} or {last}" if some else last
            raise ProblemError(
                f"{option_name(option)} goes with --for {fitting}; got --for {arguments.target}."
            )
    output = Path(arguments.output)
    places = [output, *(output.parent / (output.stem + ending) for ending in target.endings[1:])]
    if not target.contents:
        places.append(output.parent / (output.name + CERTIFICATE))
    if target.contents and output.is_dir():
        places = [output / name for name in target.contents]
    require_writable(*places, inputs=[arguments.gain])
    design = load_gain(arguments.gain)
    digest = file_sha256(arguments.gain, GainFileError)
    with show_spinner("exporting", quiet=arguments.json):
        written = target.write(output, design, gain_digest=digest, **options)
    cost = written.cost or frame_cost(design)
    report = Report(
        data={"gain": arguments.gain, "gain_digest": digest, "target": arguments.target}
    )
    commands, measurements = design.controller.D.shape[-2:]
    largest = {"unit": "of the largest command"}
    what = facts(
        method=fact(design.method, "method"),
        n_states=fact(design.controller.n_states, "states of the controller"),
        measurements=fact(measurements, "measurements"),
        commands=fact(commands, "commands"),
        error=fact(written.error, "difference from the controller", **largest),
        error_single=fact(written.error_single, "  in single precision", **largest),
        stable_single=fact(math.isfinite(written.error_single), "  stable in single precision"),
    )
    report.data |= {"frame_cost": json_record(cost), **json_record(what)}
    report.tables.append(fact_table("Export", what, *([cost] if written.cost else [])))
    if written.checks:
        report.add_rows("checks", "Checks in the arithmetic of the target", written.checks)
    report.notes += _precision_notes(arguments, written)
    report.note_files(written.files)
    return report


def _precision_notes(arguments: Namespace, written: Exported) -> list[str]:
    if written.made_again:
        return [
            "note: the coefficients were made again for the arithmetic of the target; the loop "
            "keeps what the gain file promises."
        ]
    if arguments.precision == "single" and not written.error <= _SINGLE_SUFFICES:
        return [
            f"note: in single precision commands are off by {written.error:.2g} of the largest "
            "one. Export with --precision double."
        ]
    return []
