"""The command export: a gain file in the form that another program loads."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.arguments import given_options, option_name
from lbt_synth.cli.output import Report
from lbt_synth.errors import GainFileError, ProblemError
from lbt_synth.files import load_gain
from lbt_synth.interop import export, frame_cost, target_named
from lbt_synth.interop.pipeline import target_names
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import fact, facts

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
    require_writable(*target.places(output), inputs=[arguments.gain])
    design = load_gain(arguments.gain)
    digest = file_sha256(arguments.gain, GainFileError)
    written = export(output, design, arguments.target, gain_digest=digest, **options)
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
    )
    report.add_facts("Export", what)
    if arguments.target == "c" and not design.other_sensors:
        report.add_facts("Cost per frame", frame_cost(design), key="frame_cost")
    if written.checks:
        report.add_rows("checks", "Checks in the arithmetic of the target", written.checks)
    report.notes += [f"note: {note}." for note in written.notes]
    report.note_files(written.files)
    return report
