"""The command simulate: the loop in the time domain, whose sensors may fail on the way."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import (
    load_designs,
    load_shown,
    loop_difference_notes,
    truth_at_sensor_gain,
)
from lbt_synth.cli.output import PERCENT, RMS, Report, require_figure, write_telemetry
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import GainFileError, ProblemError, UnstableLoopError
from lbt_synth.files import Telemetry, telemetry_from_simulation
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.linear import estimator_form
from lbt_synth.loop import (
    Imaging,
    ResidualBudget,
    Simulation,
    least_residual,
    residual_budget,
    simulate,
    strehl,
)
from lbt_synth.loop.least_residuals.residual_limit import above_percent, limit_or_nan
from lbt_synth.loop.simulation.run import READINGS, Drop, settling_frames
from lbt_synth.models import Truth
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures.records import sensor_failure_figure, simulation_figure
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import Facts, fact, facts
from lbt_synth.storage.words import count_text
from lbt_synth.studies.robustness import run_failures
from lbt_synth.validation import FloatArray

_TIME = r"(\d+\.?\d*)s?"
_DROP = re.compile(rf"([^@]+)@{_TIME}(?:\.\.{_TIME})?(?::({'|'.join(READINGS)}))?")
_AFTER_S = 5.0  # that a run lasts beyond the last event, if --frames is not given


def parse_drop(text: str) -> Drop:
    """Return what ``--drop SENSOR@START[..END][:READING]`` says."""
    match = _DROP.fullmatch(text)
    if match is None:
        raise ProblemError(
            f"--drop takes SENSOR@START..END, in seconds, and if need be one of "
            f"{', '.join(':' + word for word in READINGS)}; got {text!r}. Try m2@10s or "
            "wavefront@20s..20.2s:frozen."
        )
    unit, start, end, reading = match.groups()
    ends = {"start_s": float(start), "end_s": float(end or "inf")}
    return Drop(unit=unit, **ends, reading=reading or READINGS[0])


_PARTS = {"turbulence": "turbulence", "vibration": "vibration", "noise": "noise"}
_PARTS |= {"within": "within frames"}  # of a residual


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Run:
    """A gain file in the loop: its name, the runs in time, and the answer without chance."""

    name: str
    design: Design
    simulation: Simulation
    strehls: FloatArray
    exact: ResidualBudget | None  # None of a truth that drifts
    limit_nm: float  # nan where other sensors can leave less
    settle_frames: int
    clipped: float | None  # share of the frames in which a command reached the stroke
    segments: list[tuple[Any, Any]]  # between failures and returns of sensors


def run(arguments: Namespace) -> Report:
    """Close the loop in the time domain, beside the exact answer; sensors may fail on the way."""
    inputs = [arguments.config, *arguments.gains]
    if arguments.output is not None:
        require_figure(arguments.output, inputs=inputs)
    if arguments.telemetry is not None:
        require_telemetry_name(arguments.telemetry)
        require_writable(arguments.telemetry, inputs=inputs)
    several = len(arguments.gains) > 1
    for option in ("output", "telemetry", "drop") if several else ():
        if not getattr(arguments, option):
            continue
        raise ProblemError(f"--{option} goes with one gain file; got {len(arguments.gains)}.")
    config = load_shown(arguments)
    truth = truth_at_sensor_gain(config, arguments.sensor_gain)
    designs = load_designs(arguments.gains, config)
    runs = [_run(arguments, name, design, truth, config) for name, design in designs.items()]
    report = _describe_runs(runs, truth, config)
    only = runs[0]
    if arguments.output is not None:
        report.note_written(save_figure(_draw(only), arguments.output))
    if arguments.telemetry is not None:
        recorded = _first_case(only, truth, config, arguments.gains[0])
        write_telemetry(report, arguments.telemetry, recorded, key="telemetry")
    return report


def _run(arguments: Namespace, name: str, design: Design, truth: Truth, config: Config) -> _Run:
    """Run the loop of a gain file."""
    drops = _parse_drops(arguments, name, design)
    loop = design.close(config.hardware, sensor_gain=truth.sensor_gain)
    try:
        loop.require_stable()
    except UnstableLoopError as error:
        why = " ".join([str(error), *loop_difference_notes(config, design)])
        raise UnstableLoopError(why, spectral_radius=loop.radius_per_frame) from error
    sizes: dict[str, Any] = _choose_sizes(arguments, config, drops)
    settle, segments = config.settings.simulation.settle_frames, list[tuple[Any, Any]]()
    if design.other_sensors:
        simulation, segments = run_failures(design, config, truth, drops, **sizes)
    else:  # the same settling for all controllers, so that one seed is one weather
        settle = max(settle, settling_frames(loop.radius_per_frame))
        form = estimator_form(design) if arguments.form == "estimator" else design.controller
        sizes |= {"settle_frames": settle, "stroke": arguments.stroke}
        simulation = simulate(form, truth, hardware=config.hardware, **sizes)
    limit_nm = np.nan
    if not loop.reads_others and not truth.drifts:
        limit_nm = limit_or_nan(lambda: least_residual(config.hardware.own_sensor_alone(), truth))
    clipped = None
    if arguments.stroke is not None:
        reached = np.any(np.abs(simulation.commands) >= arguments.stroke, axis=2)
        clipped = float(np.mean(reached))
    return _Run(
        name=name,
        design=design,
        simulation=simulation,
        strehls=simulation.strehl(config.imaging),
        exact=None if truth.drifts else residual_budget(loop, truth),
        limit_nm=limit_nm,
        settle_frames=settle,
        clipped=clipped,
        segments=segments,
    )


def _draw(one: _Run) -> Any:
    """Return the figure of a run."""
    title = one.design.method
    if one.design.other_sensors:
        places, exact_nm = [s for s, _ in one.segments], [row.exact_nm for _, row in one.segments]
        return sensor_failure_figure(
            one.simulation, title=title, segments=places, exact_nm=exact_nm
        )
    title += ": the first second, and spectra of all runs"
    return simulation_figure(one.simulation, title=title)


def _describe_runs(runs: Sequence[_Run], truth: Truth, config: Config) -> Report:
    """Return a line for each gain file, and all that is known of a single one."""
    imaging, first = config.imaging, runs[0].simulation
    cases, frames = first.residual_nm.shape[:2]
    rows = [_describe(one, imaging) for one in runs]
    report = Report(data={"frames": frames, "cases": cases, "seed": first.seed})
    report.data["wavelength_um"] = imaging.wavelength_um
    report.data["sensor_gain"] = config.sensor_gain * truth.sensor_gain
    if len(runs) == 1:
        report.data |= {"strehl": runs[0].strehls, "residual_nm": first.rms_nm}
        report.add_records(rows[0])
        report.data["units"]["residual_nm"] = "nm"
    for one, row in zip(runs, rows, strict=True):
        residual = nm_text(row.residual_simulated_nm, ".1f")
        said = f"{one.name} leaves {residual} rms (Strehl ratio {100 * row.strehl_simulated:.1f} %)"
        if one.exact is not None:
            said += f", and {nm_text(one.exact.rms_nm, '.1f')} without chance"
        report.verdict.append(f"{said}.")
    limits_nm = [one.limit_nm for one in runs if not np.isnan(one.limit_nm)]
    if limits_nm:
        least = nm_text(limits_nm[0], ".1f")
        report.verdict.append(
            f"No linear controller of the loop's own sensor leaves less than {least}."
        )
    caption = f"{count_text(cases, 'run')} of {frames} frames; {imaging.label}"
    report.add_rows("designs", caption, rows)
    for one in runs:
        if one.segments:
            caption = "Simulated between failures and returns of sensors"
            report.add_rows("segments", caption, [row for _, row in one.segments])
            report.tables.reverse()
            report.notes.append("note: the exact answer is with all sensors.")
        report.notes += _simulation_notes(one, config)
    if truth.drifts:
        report.notes.append(
            "note: a vibration drifts, so there is no exact answer beside the simulation."
        )
    return report


def _describe(one: _Run, imaging: Imaging) -> Facts:
    """Return the line of a run."""
    simulation, exact = one.simulation, one.exact
    command_rms = float(np.sqrt(np.sum(np.mean(simulation.commands**2, axis=(0, 1)))))
    residual_nm = None if exact is None else exact.rms_nm
    above = None
    if residual_nm is not None:
        above = round(above_percent(residual_nm, one.limit_nm), 6) + 0.0
    return facts(
        design=fact(one.name, "design"),
        residual_simulated_nm=fact(
            float(np.sqrt(np.mean(simulation.rms_nm**2))), "residual", **RMS
        ),
        residual_exact_nm=fact(residual_nm, "exact", **RMS),
        strehl_simulated=fact(float(np.mean(one.strehls)), "Strehl", **PERCENT),
        strehl_exact=fact(None if exact is None else strehl(exact, imaging), "exact", **PERCENT),
        **{
            f"{part}_nm": fact(getattr(exact, f"{part}_nm", None), word, **RMS)
            for part, word in _PARTS.items()
        },
        limit_nm=fact(one.limit_nm, unit="nm"),
        above_limit_percent=fact(above, unit="%"),
        command_rms=fact(command_rms, unit="nm"),
        clipped=fact(one.clipped),
    )


def _parse_drops(arguments: Namespace, name: str, design: Design) -> list[Drop]:
    """Return the sensors that fail; refuse options that the design has nothing for."""
    if not design.other_sensors and arguments.drop:
        raise ProblemError(
            "--drop goes with a design of several sensors: give sensors in the configuration and "
            f"design again. {name} has the loop's own sensor alone."
        )
    own_alone = ("stroke", "form", "telemetry") if design.other_sensors else ()
    for option in given_options(arguments, *own_alone):
        raise ProblemError(f"--{option} goes with a design of the loop's own sensor alone.")
    return [parse_drop(text) for text in arguments.drop or ()]


def _choose_sizes(arguments: Namespace, config: Config, drops: Sequence[Drop]) -> dict[str, int]:
    """Return frames, cases and seed of a run, which reaches beyond the last failure."""
    settings, rate = config.settings.simulation, config.hardware.frame_rate_hz
    last_s = max((t for d in drops for t in (d.start_s, d.end_s) if np.isfinite(t)), default=0.0)
    usual = max(settings.frames, int(np.ceil((last_s + _AFTER_S) * rate)) if drops else 0)
    sizes = {"frames": usual, "cases": settings.cases, "seed": settings.seed}
    sizes |= given_options(arguments, *sizes)
    if drops and last_s * rate >= sizes["frames"]:
        raise ProblemError(
            f"--frames must reach beyond the last --drop, {last_s:g} s or {last_s * rate:.0f} "
            f"frames; got {sizes['frames']}."
        )
    return sizes


def _simulation_notes(one: _Run, config: Config) -> list[str]:
    notes = []
    if one.clipped is not None:
        notes.append(
            f"note: the mirror clipped the commands of {one.clipped:.2%} of the frames; the exact "
            "answer has no limit of the stroke."
        )
    if one.strehls.size > 1:
        scatter = 100 * np.std(one.strehls, ddof=1)
        notes.append(f"scatter of the Strehl ratio between runs: {scatter:.2f} points")
    usual = config.settings.simulation.settle_frames
    if one.settle_frames > usual:
        notes.append(
            f"note: this loop settles for {one.settle_frames} frames, not {usual}; its random "
            "series are not those of a faster loop with the same seed. Raise "
            "simulation.settle_frames."
        )
    return notes + loop_difference_notes(config, one.design)


def _first_case(one: _Run, truth: Truth, config: Config, gain_file: str) -> Telemetry:
    noise_nm = truth.noise_per_measurement(config.hardware.n_measurements).tolist()
    noise = {f"noise_nm_{i}": value for i, value in enumerate(noise_nm, start=1)}
    return telemetry_from_simulation(
        one.simulation,
        config.hardware,
        sensor_gain=truth.sensor_gain,
        design=one.design,
        controller_digest=file_sha256(gain_file, GainFileError),
        imaging=config.imaging,
        metadata={"case": 0, "cases": len(one.simulation.commands), **noise},
    )
