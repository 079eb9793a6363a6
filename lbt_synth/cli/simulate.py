"""The command simulate: the loop in the time domain, whose sensors may fail on the way."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import load_shown, loop_difference_notes, truth_at_sensor_gain
from lbt_synth.cli.output import Report, require_figure, write_telemetry
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import GainFileError, ProblemError, UnstableLoopError
from lbt_synth.files import Telemetry, load_gain, telemetry_from_simulation
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.linear import estimator_form
from lbt_synth.loop import (
    ClosedLoop,
    Imaging,
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
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.input_files import file_sha256
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


_RMS = "nm rms"
_QUANTITIES = {  # of the table, by their keys: headings and units
    "strehl_exact": ("Strehl ratio", "%"),
    "residual_exact_nm": ("residual", _RMS),
    "turbulence_nm": ("  turbulence", _RMS),
    "vibration_nm": ("  vibration", _RMS),
    "noise_nm": ("  noise", _RMS),
    "within_nm": ("  within frames", _RMS),
    "limit_nm": ("  least of any controller", _RMS),
    "above_limit_percent": ("  residual above it", "%"),
    "command_rms": ("commands", _RMS),
}


def run(arguments: Namespace) -> Report:
    """Close the loop in the time domain, beside the exact answer; sensors may fail on the way."""
    inputs = [arguments.config, arguments.gain]
    if arguments.output is not None:
        require_figure(arguments.output, inputs=inputs)
    if arguments.telemetry is not None:
        require_telemetry_name(arguments.telemetry)
        require_writable(arguments.telemetry, inputs=inputs)
    config = load_shown(arguments)
    design = load_gain(arguments.gain)
    drops = _parse_drops(arguments, design)
    truth = truth_at_sensor_gain(config, arguments.sensor_gain)
    loop = design.close(config.hardware, sensor_gain=truth.sensor_gain)
    try:
        loop.require_stable()
    except UnstableLoopError as error:
        why = " ".join([str(error), *loop_difference_notes(config, design)])
        raise UnstableLoopError(why, spectral_radius=loop.radius_per_frame) from error
    settings = config.settings.simulation
    sizes: dict[str, Any] = _choose_sizes(arguments, config, drops)
    # the same settling for all controllers, so that one seed is one weather
    settle = max(settings.settle_frames, settling_frames(loop.radius_per_frame))
    title = design.method
    if design.other_sensors:
        settle = settings.settle_frames
        simulation, segments = run_failures(design, config, truth, drops, **sizes)
        places, exact_nm = [s for s, _ in segments], [row.exact_nm for _, row in segments]
        draw = partial(sensor_failure_figure, segments=places, exact_nm=exact_nm)
    else:
        simulation, segments = _simulate(arguments, design, truth, config, settle, sizes), []
        title += ": the first second, and spectra of all runs"
        draw = partial(simulation_figure)
    strehls = simulation.strehl(config.imaging)
    report = _describe_simulation(
        simulation, strehls, _exact_answers(loop, config, truth), design, config.imaging
    )
    report.data["sensor_gain"] = config.sensor_gain * truth.sensor_gain
    if segments:
        caption = "Simulated between failures and returns of sensors"
        report.add_rows("segments", caption, [row for _, row in segments])
    report.notes += _simulation_notes(config, design, strehls, settle, drifts=truth.drifts)
    if drops:
        report.notes.append("note: the exact answer above is with all sensors.")
    _add_clipped(report, simulation, arguments.stroke)
    if arguments.output is not None:
        report.note_written(save_figure(draw(simulation, title=title), arguments.output))
    if arguments.telemetry is not None:
        recorded = _first_case(simulation, truth, config, design, arguments.gain)
        write_telemetry(
            report, arguments.telemetry, recorded, key="telemetry", what="telemetry of case 0"
        )
    return report


def _simulate(
    arguments: Namespace,
    design: Design,
    truth: Truth,
    config: Config,
    settle_frames: int,
    sizes: dict[str, Any],
) -> Simulation:
    """Run the loop of its own sensor, in the form that was asked for."""
    form = estimator_form(design) if arguments.form == "estimator" else design.controller
    more: dict[str, Any] = {"settle_frames": settle_frames, "stroke": arguments.stroke, **sizes}
    return simulate(form, truth, hardware=config.hardware, **more)


def _add_clipped(report: Report, simulation: Simulation, stroke: float | None) -> None:
    """Say how often the mirror did not reach what was commanded, if it has a stroke."""
    if stroke is None:
        return
    clipped = np.mean(np.any(np.abs(simulation.commands) >= stroke, axis=2))
    report.data["clipped"] = float(clipped)
    report.notes.append(
        f"note: the mirror clipped the commands of {clipped:.2%} of the frames; the exact "
        "answer has no limit of the stroke."
    )


def _parse_drops(arguments: Namespace, design: Design) -> list[Drop]:
    """Return the sensors that fail; refuse options that the design has nothing for."""
    if not design.other_sensors and arguments.drop:
        raise ProblemError(
            "--drop goes with a design of several sensors: give sensors in the configuration and "
            f"design again. {arguments.gain} has the loop's own sensor alone."
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


def _describe_simulation(
    simulation: Simulation,
    strehls: FloatArray,
    exact: dict[str, float | None],
    design: Design,
    imaging: Imaging,
) -> Report:
    command_rms = float(np.sqrt(np.sum(np.mean(simulation.commands**2, axis=(0, 1)))))
    cases, frames = simulation.residual_nm.shape[:2]
    units = {name: unit for name, (_, unit) in _QUANTITIES.items() if name != "strehl_exact"}
    report = Report(
        data={
            "strehl": strehls,
            "residual_nm": simulation.rms_nm,
            **exact,
            "command_rms": command_rms,
            "units": {"residual_nm": _RMS, **units},
            "frames": frames,
            "wavelength_um": imaging.wavelength_um,
            "cases": cases,
            "seed": simulation.seed,
        }
    )
    simulated = {
        "strehl_exact": float(np.mean(strehls)),
        "residual_exact_nm": float(np.sqrt(np.mean(simulation.rms_nm**2))),
        "command_rms": command_rms,
    }
    rows = []
    for name, (heading, raw) in _QUANTITIES.items():
        unit, factor = shown_unit(raw)
        factor = 100.0 if name == "strehl_exact" else factor
        pair = [value and factor * value for value in (simulated.get(name), exact.get(name))]
        if pair != [None, None]:
            rows.append((heading, *pair, unit))
    caption = f"{design.method} in the loop: {count_text(cases, 'run')} of {frames} frames"
    headings = ("quantity", "simulated", "exact", "unit")
    report.add_table(f"{caption}; {imaging.label}", headings, rows)
    return report


def _exact_answers(loop: ClosedLoop, config: Config, truth: Truth) -> dict[str, float | None]:
    """Return what the loop leaves without chance; a truth that drifts has no exact answer."""
    if truth.drifts:
        return dict.fromkeys([name for name in _QUANTITIES if name != "command_rms"])
    image = residual_budget(loop, truth)
    limit_nm = np.nan  # what other sensors read can leave less
    if not loop.reads_others:
        limit_nm = limit_or_nan(lambda: least_residual(config.hardware.own_sensor_alone(), truth))
    names = ("turbulence_nm", "vibration_nm", "noise_nm", "within_nm")
    return {name: getattr(image, name) for name in names} | {
        "strehl_exact": strehl(image, config.imaging),
        "residual_exact_nm": image.rms_nm,
        "limit_nm": limit_nm,
        "above_limit_percent": round(above_percent(image.rms_nm, limit_nm), 6) + 0.0,
    }


def _simulation_notes(
    config: Config, design: Design, strehls: FloatArray, settle: int, *, drifts: bool
) -> list[str]:
    notes = []
    if drifts:
        notes.append("note: a vibration drifts, so there is no exact answer beside the simulation.")
    if strehls.size > 1:
        scatter = 100 * np.std(strehls, ddof=1)
        notes.append(f"scatter of the Strehl ratio between runs: {scatter:.2f} points")
    usual = config.settings.simulation.settle_frames
    if settle > usual:
        notes.append(
            f"note: this loop settles for {settle} frames, not {usual}; its random series are not "
            "those of a faster loop with the same seed. Raise simulation.settle_frames."
        )
    return notes + loop_difference_notes(config, design)


def _first_case(
    simulation: Simulation, truth: Truth, config: Config, design: Design, gain_file: str
) -> Telemetry:
    noise_nm = truth.noise_per_measurement(config.hardware.n_measurements).tolist()
    noise = {f"noise_nm_{i}": value for i, value in enumerate(noise_nm, start=1)}
    return telemetry_from_simulation(
        simulation,
        config.hardware,
        sensor_gain=truth.sensor_gain,
        design=design,
        controller_digest=file_sha256(gain_file, GainFileError),
        imaging=config.imaging,
        metadata={"case": 0, "cases": len(simulation.commands), **noise},
    )
