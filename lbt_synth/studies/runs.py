"""Runs in time: on drawn series, while sensors fail, and of a record in another program."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification import LoopRecord
from lbt_synth.interop.pipeline import Rehearsal, rehearse
from lbt_synth.linear import estimator_form
from lbt_synth.loop import ClosedLoop, Imaging, close_loop, residual_budget, simulate, strehl
from lbt_synth.loop.budget import ResidualBudget
from lbt_synth.loop.disturbances import Disturbance
from lbt_synth.loop.simulation import Drop, Segment, Simulation, run_segments, settling_frames
from lbt_synth.loop.strehl import series_strehl
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.storage.rows import NM, PERCENT, Facts, fact, facts
from lbt_synth.studies.grid import evaluate
from lbt_synth.validation import FloatArray


class DesignRun(NamedTuple):
    """A run of a design in time, beside the exact answer."""

    row: Facts  # what it left
    simulation: Simulation
    segments: list[tuple[Segment, Facts]]  # between failures and returns of sensors
    notes: list[str]  # what is to be known of the numbers


def run_design(
    name: str,
    design: Design,
    truth: Truth,
    config: Config,
    *,
    drops: Sequence[Drop] = (),
    estimates: bool = False,
    stroke: float | None = None,
    frames: int,
    cases: int,
    seed: int,
    executor: Executor | None = None,
) -> DesignRun:
    """Run the loop of a configuration for some frames and cases; sensors may fail on the way.

    A controller that estimates is given the commands that a mirror of this stroke applied.
    """
    loop = design.close(config.hardware, sensor_gain=truth.sensor_gain)
    loop.require_stable()
    usual, notes = config.settings.simulation.settle_frames, list[str]()
    # the same settling for all controllers, so that one seed is one weather
    settle = max(usual, settling_frames(loop.radius_per_frame))
    simulation = simulate(
        estimator_form(design) if estimates else design,
        truth,
        hardware=loop.hardware,
        frames=frames,
        cases=cases,
        seed=seed,
        settle_frames=settle,
        stroke=stroke,
        drops=drops,
    )
    segments: list[tuple[Segment, Facts]] = []
    if design.other_sensors:
        times = run_segments(drops, frames / loop.hardware.frame_rate_hz)
        samples = ((design, loop, truth, simulation, one, config.imaging) for one in times)
        segments += zip(times, evaluate(_segment_row, samples, executor), strict=True)
        notes.append("the exact answer is with all sensors.")
    if settle > usual:
        notes.append(
            f"this loop settles for {settle} frames, not {usual}; its random series are not "
            "those of a faster loop with the same seed. Raise simulation.settle_frames."
        )
    clipped = None
    if stroke is not None:
        clipped = float(np.mean(np.any(np.abs(simulation.commands) >= stroke, axis=2)))
        notes.append(
            f"the mirror clipped the commands of {clipped:.2%} of the frames; the exact answer has "
            "no limit of the stroke."
        )
    exact = None if truth.drifts else residual_budget(loop, truth)
    row = _run_row(name, simulation, exact, clipped, config.imaging)
    return DesignRun(row, simulation, segments, notes)


def _run_row(
    name: str,
    simulation: Simulation,
    exact: ResidualBudget | None,
    clipped: float | None,
    imaging: Imaging,
) -> Facts:
    """Return what a run left, with the exact answer unless a vibration drifts."""
    strehls, rms_nm = simulation.strehl(imaging), simulation.rms_nm
    residual_nm = exact_ratio = None
    if exact is not None:
        residual_nm, exact_ratio = exact.rms_nm, strehl(exact, imaging)
    command_rms = float(np.sqrt(np.sum(np.mean(simulation.commands**2, axis=(0, 1)))))
    return facts(
        design=fact(name, "design"),
        residual_simulated_nm=fact(
            float(np.sqrt(np.mean(rms_nm**2))), "residual", **NM, missing="unstable"
        ),
        residual_exact_nm=fact(residual_nm, "exact", **NM),
        strehl_simulated=fact(float(np.mean(strehls)), "Strehl", **PERCENT),
        strehl_exact=fact(exact_ratio, "exact", **PERCENT),
        command_rms=fact(command_rms, "commands", **NM),
        clipped=fact(clipped),
        cases_residual_nm=fact(rms_nm.tolist(), unit="nm"),
        cases_strehl=fact(strehls.tolist()),
    )


def _segment_row(
    design: Design,
    loop: ClosedLoop,
    truth: Truth,
    simulation: Simulation,
    segment: Segment,
    imaging: Imaging,
) -> Facts:
    """Return what a loop leaves while some sensors fail, in a run and, where it can be, exactly."""
    closed = close_loop(
        loop.hardware,
        design.controllers[frozenset(segment.missing)],
        sensor_gain=truth.sensor_gain,
        blind=(*segment.missing, *segment.wrong),
    )
    # a frozen reading adds an offset of its own
    exact = closed.is_stable and not truth.drifts and "frozen" not in segment.wrong.values()
    rate = loop.hardware.frame_rate_hz
    first, last = (int(np.ceil(t * rate - 1e-6)) for t in (segment.start_s, segment.end_s))
    run = simulation.part(first, last)
    exact_nm = residual_budget(closed, truth).rms_nm if exact else np.nan
    ratio = float(np.mean(run.strehl(imaging))) if closed.is_stable else np.nan
    rms, second = {"unit": "nm rms", "format": ".2f"}, {"unit": "s", "format": "g"}
    return facts(
        start_s=fact(segment.start_s, "from", **second),
        end_s=fact(segment.end_s, "to", **second),
        sensors=fact(segment.text or "none", "sensors that fail"),
        residual_nm=fact(float(np.sqrt(np.mean(run.rms_nm**2))), "simulated", **rms),
        exact_nm=fact(exact_nm, "exact, once settled", **rms),
        strehl=fact(ratio, "Strehl", **PERCENT),
        stable=fact(closed.is_stable, "stable"),
    )


def rehearse_record(
    design: Design,
    record: LoopRecord,
    target: str,
    imaging: Imaging,
    *,
    stroke: float | None = None,
) -> tuple[Rehearsal, list[Facts], LoopHardware]:
    """Rehearse a design on the longest stretch of a record that has no gap.

    A row for the target, the design and what ran comes with it, and the loop of the record with the
    sensor gains that are assumed.
    """
    gains = _assumed_gains(design, record)
    start, stop = max(record.stretches(), key=lambda pair: pair[1] - pair[0])
    phase_nm = record.pseudo_open_loop(gains)[start:stop]
    hardware = replace(record.hardware, sensor_matrix=np.diag(gains))
    series = Disturbance(phase_nm=phase_nm, frame_means=True)
    rehearsal = rehearse(design, target, series, hardware=hardware, stroke=stroke)
    rows = []
    for name, run in ((f"in {target}", rehearsal.target), ("design", rehearsal.design)):
        left = run.residual_nm[0], run.image_nm2[0], run.commands[0]
        rows.append(_loop_row(name, *left, imaging, rehearsal.clipped_frames(run)))
    if record.commands is not None:
        settled = slice(start + rehearsal.settle_frames, stop)
        residual_nm, commands = record.measurements[settled] / gains, record.commands[settled]
        rows.append(_loop_row("what ran", residual_nm, residual_nm**2, commands, imaging, None))
    return rehearsal, rows, hardware


def _loop_row(
    name: str,
    residual_nm: FloatArray,
    squares_nm2: FloatArray,
    commands: FloatArray,
    imaging: Imaging,
    clipped: int | None,
) -> Facts:
    """Return the row of one loop on the series, from its residual and squares (frames, axes)."""
    axes = np.sqrt(np.mean(squares_nm2, axis=0)).tolist()
    second, ratio = axes[1] if len(axes) == 2 else None, None
    if len(axes) <= 2:
        within_nm2 = np.mean(squares_nm2 - residual_nm**2, axis=0)
        ratio = series_strehl(residual_nm, imaging, within_nm2=within_nm2)
    rms = {**NM, "unit": "nm rms"}
    largest_nm = float(np.max(np.abs(commands)))
    return facts(
        name=fact(name, "loop"),
        first_nm=fact(axes[0], "first axis", **rms),
        second_nm=fact(second, "second axis", **rms),
        residual_nm=fact(float(np.linalg.norm(axes)), "residual", **rms),
        strehl=fact(ratio, "Strehl", **PERCENT),
        largest_command_nm=fact(largest_nm, "largest command", **NM),
        clipped_frames=fact(clipped, "clipped frames"),
    )


def _assumed_gains(design: Design, record: LoopRecord) -> FloatArray:
    """Return the sensor gain of each axis: the stated one, else the one that a design assumes."""
    sensor = np.eye(record.axes) if design.hardware is None else design.hardware.sensor
    gains = np.diag(sensor)
    if sensor.shape != (record.axes, record.axes) or not np.array_equal(sensor, np.diag(gains)):
        raise ProblemError(
            f"a rehearsal on a record takes a measurement for each of its {record.axes} axes; the "
            f"gain file assumes a sensor matrix {sensor.tolist()}. Design for the axes of the "
            "record."
        )
    return record.known_gains(record.stated_gain) if record.stated_gain else gains
