"""The commands export and rehearse: a gain file in another program, and its loop there."""

from __future__ import annotations

from argparse import Namespace
from itertools import chain
from pathlib import Path

import numpy as np

from lbt_synth.cli.arguments import given_options, input_files, refuse_options
from lbt_synth.cli.loop_inputs import load_designs
from lbt_synth.cli.output import Report
from lbt_synth.cli.telemetry import load_series, record_imaging, require_series
from lbt_synth.design.certificate import say_checks
from lbt_synth.errors import GainFileError
from lbt_synth.files import load_gain
from lbt_synth.identification.records.record import require_length
from lbt_synth.interop import export
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.interop.pipeline import target_named, target_names
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.figures.records import simulation_figure
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import fact, facts
from lbt_synth.storage.words import listing_text
from lbt_synth.studies.runs import rehearse_record

_FEWEST = 256  # frames of a record: a loop needs some to settle, and some to compare


def run_export(arguments: Namespace) -> Report:
    """Write the controller of a gain file for another program."""
    accepted = {name: target_named(name).options for name in target_names()}
    options = given_options(arguments, *chain(*accepted.values()))
    for option in options:
        fitting = [name for name in accepted if option in accepted[name]]
        if arguments.target not in fitting:
            why = f"goes with --for {' or '.join(fitting)}; got --for {arguments.target}"
            refuse_options(arguments, [option], why)
    output, target = Path(arguments.output), target_named(arguments.target)
    require_writable(*target.places(output), inputs=input_files(arguments))
    design = load_gain(arguments.gain)
    digest = file_sha256(arguments.gain, GainFileError)
    written = export(output, design, arguments.target, gain_digest=digest, **options)
    report = Report(data={"gain": arguments.gain, "gain_digest": digest})
    report.data["target"] = arguments.target
    report.verdict.append(
        f"What {arguments.target} computes differs from the controller by {written.error:.2g} of "
        "the largest command."
    )
    if written.checks:
        report.verdict.append(say_checks(written.checks))
    commands, measurements = design.controller.D.shape[-2:]
    what = facts(
        method=fact(design.method, "method"),
        n_states=fact(design.controller.n_states, "states of the controller"),
        measurements=fact(measurements, "measurements"),
        commands=fact(commands, "commands"),
        error=fact(written.error, "difference from the controller", unit="of the largest command"),
    )
    report.add_facts("Export", what)
    if arguments.target == "c" and not design.other_sensors:
        report.add_facts("Cost per frame", frame_cost(design), key="frame_cost")
    if written.checks:
        report.add_rows("checks", "Checks in the arithmetic of the target", written.checks)
    report.notes += [f"note: {note}." for note in written.notes]
    report.note_written(*written.files)
    return report


def run_rehearse(arguments: Namespace) -> Report:
    """Run the loop of a record in the arithmetic of a target, beside the design and what ran."""
    target, (design,) = arguments.target, load_designs([arguments.gain]).values()
    record = require_series(load_series(arguments), "a rehearsal runs on").bridged()
    require_length(record, frames=_FEWEST, seconds=0)
    imaging = record_imaging(arguments, record)
    rehearsal, rows, hardware = rehearse_record(
        design, record, target, imaging, stroke=arguments.stroke
    )
    leaves = [f"{nm_text(row.residual_nm, '.1f')} rms ({row.name})" for row in rows]
    apart_nm = rehearsal.differences
    frames = rehearsal.settle_frames + len(apart_nm)
    source = f"{frames} frames of {Path(arguments.file).name}"
    report = Report(data={"gain": arguments.gain, "target": target})
    report.verdict = [f"On {source}: {listing_text(leaves)}.", say_checks(rehearsal.checks)]
    title = f"{design.method} in {target}"
    report.add_rows(
        "loops",
        f"Rehearsal for {target}; {imaging.label}",
        rows,
        figure=lambda: simulation_figure(rehearsal.target, title=title),
    )
    differences = facts(
        difference_rms_nm=fact(
            float(np.sqrt(np.mean(np.sum(apart_nm**2, axis=1)))),
            "difference of the commands",
            unit="nm rms",
        ),
        difference_largest_nm=fact(float(np.max(np.abs(apart_nm))), "  largest", unit="nm"),
        frames=fact(len(apart_nm), "frames compared"),
        settle_frames=fact(rehearsal.settle_frames, "frames before, in which the loops settle"),
    )
    report.add_facts("The target beside the design", differences)
    report.add_rows("checks", f"Checks in the arithmetic of {target}", rehearsal.checks)
    report.notes += [
        "note: residuals are of means over frames, and hold the noise of the measurements.",
        "note: Strehl ratios are of tip and tilt alone; the record knows no other modes.",
    ]
    if design.hardware is not None:
        report.notes += [f"note: {text}" for text in loop_differences(design.hardware, hardware)]
    return report
