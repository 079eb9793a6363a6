"""The commands export and rehearse: a gain file in another program, and its loop there."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from lbt_synth.cli.arguments import command_options, given_options, option_name, refuse_options
from lbt_synth.cli.loop_inputs import choose_unit, load_design, load_shown
from lbt_synth.cli.output import PERCENT, Report, say_checks
from lbt_synth.cli.telemetry import load_series, record_imaging, require_series
from lbt_synth.config.load import config_from_text
from lbt_synth.design import Design
from lbt_synth.errors import GainFileError, ProblemError
from lbt_synth.files import load_gain
from lbt_synth.identification.records.record import require_length
from lbt_synth.interop import export, rehearse
from lbt_synth.interop.c.export import frame_cost
from lbt_synth.interop.pipeline import Rehearsal, target_named, target_names
from lbt_synth.loop import Imaging
from lbt_synth.loop.simulation.disturbances import Disturbance, draw_disturbance
from lbt_synth.loop.strehl import series_strehl
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.figures.records import simulation_figure
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import Facts, fact, facts
from lbt_synth.storage.words import listing_text
from lbt_synth.validation import FloatArray, integer

_OPTIONS = ("form", "precision", "name", "order", "modes", "other_gain", "steps", "loss")
_DRAWN = ("frames", "seed")  # options that only a drawn disturbance has
_ALWAYS = ("target", "stroke", "wavelength_um", "output", "json", "verbose", "unit", "show_unit")
_FEWEST = 256  # frames of a record: a loop needs some to settle, and some to compare

# the source in words, what the loops run on, and residual and commands of a record
_Series: TypeAlias = tuple[
    str, Disturbance, LoopHardware, Imaging, tuple[FloatArray, FloatArray] | None
]


def run_export(arguments: Namespace) -> Report:
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
    report.note_files(written.files)
    return report


def run_rehearse(arguments: Namespace) -> Report:
    """Run the loop in the arithmetic of a target, beside the design and what ran."""
    target, recorded = arguments.target, arguments.file is not None
    idle = set(command_options("rehearse")) - {*_DRAWN, *_ALWAYS}
    why = "goes without a record" if recorded else "goes with a record"
    refuse_options(arguments, _DRAWN if recorded else sorted(idle), why)
    design = load_design(arguments.gain)
    series = (_recorded if recorded else _drawn)(arguments, design)
    source, disturbance, hardware, imaging, ran = series
    rehearsal = rehearse(design, target, disturbance, hardware=hardware, stroke=arguments.stroke)
    rows = []
    for name, run in ((f"in {target}", rehearsal.target), ("design", rehearsal.design)):
        clipped = rehearsal.clipped_frames(run)
        squares, commands = run.image_nm2[0], run.commands[0]
        rows.append(_describe(name, squares, commands, run.strehl, imaging, clipped))
    if ran is not None:
        residual, commands = (signal[rehearsal.settle_frames :] for signal in ran)

        def ratio(camera: Imaging) -> FloatArray:
            return np.array([series_strehl(residual, camera)])

        rows.append(_describe("what ran", residual**2, commands, ratio, imaging, None))
    leaves = [f"{nm_text(row.residual_nm, '.1f')} rms ({row.name})" for row in rows]
    report = Report(data={"gain": arguments.gain, "target": target})
    report.verdict = [f"On {source}: {listing_text(leaves)}.", say_checks(rehearsal.checks)]
    title = f"{design.method} in {target}"
    report.add_rows(
        "loops",
        f"Rehearsal for {target}; {imaging.label}",
        rows,
        figure=lambda: simulation_figure(rehearsal.target, title=title),
    )
    report.add_facts("The target beside the design", _difference_facts(rehearsal))
    report.add_rows("checks", f"Checks in the arithmetic of {target}", rehearsal.checks)
    if recorded:
        report.notes += [
            "note: residuals are of means over frames, and hold the noise of the measurements.",
            "note: Strehl ratios are of tip and tilt alone; the record knows no other modes.",
        ]
    if design.hardware is not None:
        report.notes += [f"note: {text}" for text in loop_differences(design.hardware, hardware)]
    return report


def _describe(
    name: str,
    squares_nm2: FloatArray,
    commands: FloatArray,
    strehl: Callable[[Imaging], FloatArray],
    imaging: Imaging,
    clipped: int | None,
) -> Facts:
    """Return the row of one loop on the series, from the squares of its residual."""
    axes = np.sqrt(np.mean(squares_nm2, axis=0)).tolist()
    second = axes[1] if len(axes) == 2 else None
    ratio = float(strehl(imaging)[0]) if len(axes) <= 2 else None
    rms = {"unit": "nm rms", "format": ".1f"}
    largest_nm = float(np.max(np.abs(commands)))
    return facts(
        name=fact(name, "loop"),
        first_nm=fact(axes[0], "first axis", **rms),
        second_nm=fact(second, "second axis", **rms),
        residual_nm=fact(float(np.linalg.norm(axes)), "residual", **rms),
        strehl=fact(ratio, "Strehl", **PERCENT),
        largest_command_nm=fact(largest_nm, "largest command", unit="nm", format=".1f"),
        clipped_frames=fact(clipped, "clipped frames"),
    )


def _difference_facts(rehearsal: Rehearsal) -> Facts:
    """Return how far the target is from the design."""
    apart_nm = rehearsal.differences
    rms_nm = float(np.sqrt(np.mean(np.sum(apart_nm**2, axis=1))))
    settled = "frames before, in which the loops settle"
    return facts(
        difference_rms_nm=fact(rms_nm, "difference of the commands", unit="nm rms"),
        difference_largest_nm=fact(float(np.max(np.abs(apart_nm))), "  largest", unit="nm"),
        frames=fact(len(apart_nm), "frames compared"),
        settle_frames=fact(rehearsal.settle_frames, settled),
    )


def _recorded(arguments: Namespace, design: Design) -> _Series:
    """Return the pseudo-open-loop series of a record, in its longest stretch of usable frames.

    Its sensor gain is the one that the design assumes, unless another is given.
    """
    record = require_series(load_series(arguments), "a rehearsal runs on").bridged()
    require_length(record, frames=_FEWEST, seconds=0)
    choose_unit(arguments, record.diameter_m)
    gains = _assumed_gains(design, record.axes)
    if record.stated_gain:
        gains = record.known_gains(record.stated_gain)
    start, stop = max(record.stretches(), key=lambda pair: pair[1] - pair[0])
    commands = record.commands
    ran = None
    if commands is not None:
        ran = (record.measurements[start:stop] / gains, commands[start:stop])
    phase_nm = record.pseudo_open_loop(gains)[start:stop]
    return (
        f"{stop - start} frames of {Path(arguments.file).name}",
        Disturbance(phase_nm=phase_nm, frame_means=True),
        replace(record.hardware, sensor_matrix=np.diag(gains)),
        record_imaging(arguments, record),
        ran,
    )


def _assumed_gains(design: Design, axes: int) -> FloatArray:
    """Return what the measurements of each axis show of a unit of phase, as a design assumes."""
    sensor = np.eye(axes) if design.hardware is None else design.hardware.sensor
    gains = np.diag(sensor)
    if sensor.shape != (axes, axes) or not np.array_equal(sensor, np.diag(gains)):
        raise ProblemError(
            f"a rehearsal on a record takes a measurement for each of its {axes} axes; the gain "
            f"file assumes a sensor matrix {sensor.tolist()}. Design for the axes of the record."
        )
    return gains


def _drawn(arguments: Namespace, design: Design) -> _Series:
    """Return a disturbance drawn from the truth that the gain file was made with."""
    if not design.configuration:
        raise ProblemError(
            "the gain file holds no configuration to draw a disturbance from. Give a record, too."
        )
    config = config_from_text(design.configuration, Path(arguments.gain))
    load_shown(arguments, config)
    imaging = config.imaging
    if arguments.wavelength_um is not None:
        imaging = replace(imaging, wavelength_um=arguments.wavelength_um)
    alone = config.hardware.own_sensor_alone()
    seed = integer(arguments.seed, "--seed", at_least=0)
    frames = integer(arguments.frames, "--frames", at_least=1)
    drawn = draw_disturbance(config.truth, alone, frames=frames, seed=seed)
    return f"{frames} frames of its own truth", drawn, config.hardware, imaging, None
