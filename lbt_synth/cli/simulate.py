"""The command simulate: the loop in the time domain, whose sensors may fail on the way."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Sequence
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import load_shown, loop_difference_notes, truth_at_sensor_gain
from lbt_synth.cli.output import Report, require_figure, write_telemetry
from lbt_synth.cli.progress import show_spinner
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
from lbt_synth.loop.simulation.run import READINGS, Drop, Segment, settling_frames
from lbt_synth.models import Truth
from lbt_synth.report.draw import save_figure
from lbt_synth.report.figures.records import sensor_failure_figure, simulation_figure
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import Facts
from lbt_synth.storage.words import count_text
from lbt_synth.studies.robustness import run_failures
from lbt_synth.validation import FloatArray

_DROP = re.compile(
    rf"(?P<unit>[^@]+)@(?P<start>[\d.]+)s?(\.\.(?P<end>[\d.]+)s?)?(:(?P<reading>{'|'.join(READINGS)}))?$"
)
_AFTER_S = 5.0  # that a run lasts beyond the last event, if --frames is not given


def parse_drop(text: str) -> Drop:
    """Return what ``--drop SENSOR@START[..END][:READING]`` says."""
    found = _DROP.match(text)
    if found is None:
        raise ProblemError(
            f"--drop takes SENSOR@START..END, in seconds, and if need be one of "
            f"{', '.join(':' + word for word in READINGS)}; got {text!r}. Try m2@10s or "
            "wavefront@20s..20.2s:frozen."
        )
    parts = found.groupdict()
    try:
        times = {k: float(parts[k.removesuffix("_s")] or "inf") for k in ("start_s", "end_s")}
    except ValueError:
        raise ProblemError(f"--drop takes times in seconds; got {text!r}.") from None
    return Drop(unit=parts["unit"], **times, reading=parts["reading"] or READINGS[0])


_QUANTITIES = {  # of the table, by their keys: ratios are shown in percent, all others are rms
    "strehl_exact": "Strehl ratio",
    "residual_exact_nm": "residual",
    "turbulence_nm": "  turbulence",
    "vibration_nm": "  vibration",
    "noise_nm": "  noise",
    "within_nm": "  within frames",
    "limit_nm": "  least of any controller",
    "above_limit_percent": "  residual above it",
    "command_rms": "commands",
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
    segments: list[tuple[Segment, Facts]] = []
    sizes: dict[str, Any] = _choose_sizes(arguments, config, drops)
    # the same settling for all controllers, so that one seed is one weather
    settle = max(settings.settle_frames, settling_frames(loop.radius_per_frame))
    with show_spinner("closing the loop", quiet=arguments.json):
        if design.other_sensors:
            settle = settings.settle_frames
            simulation, segments = run_failures(design, config, truth, drops, **sizes)
        else:
            simulation = simulate(
                estimator_form(design) if arguments.form == "estimator" else design.controller,
                truth,
                hardware=config.hardware,
                **sizes,
                settle_frames=settle,
                stroke=arguments.stroke,
            )
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
        if segments:
            places, exact_nm = [s for s, _ in segments], [row.exact_nm for _, row in segments]
            figure = sensor_failure_figure(simulation, places, exact_nm, title=design.method)
        else:
            title = f"{design.method}: the first second above, mean spectrum of all runs below"
            figure = simulation_figure(simulation, title=title)
        report.note_written(save_figure(figure, arguments.output))
    if arguments.telemetry is not None:
        recorded = _first_case(simulation, truth, config, design, arguments.gain)
        write_telemetry(
            report, arguments.telemetry, recorded, key="telemetry", what="telemetry of case 0"
        )
    return report


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
    rms = [name for name in _QUANTITIES if name.endswith(("_nm", "_rms"))]
    report = Report(
        data={
            "strehl": strehls,
            "residual_nm": simulation.rms_nm,
            **exact,
            "command_rms": command_rms,
            "units": dict.fromkeys(["residual_nm", *rms], "nm rms") | {"above_limit_percent": "%"},
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
    unit, factor = shown_unit("nm rms")
    rows = []
    for name, heading in _QUANTITIES.items():
        scale = factor if name in rms else 100.0 if name == "strehl_exact" else 1.0
        pair = [value and scale * value for value in (simulated.get(name), exact.get(name))]
        if pair != [None, None]:
            rows.append((heading, *pair, unit if name in rms else "%"))
    report.add_table(
        f"{design.method} in the loop: {count_text(cases, 'run')} of {frames} frames; "
        f"{imaging.label}",
        ("quantity", "simulated", "exact", "unit"),
        rows,
    )
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
    return telemetry_from_simulation(
        simulation,
        config.hardware,
        sensor_gain=truth.sensor_gain,
        design=design,
        controller_digest=file_sha256(gain_file, GainFileError),
        imaging=config.imaging,
        metadata={
            "case": 0,
            "cases": len(simulation.commands),
            **{
                f"noise_nm_{i}": float(noise_nm)
                for i, noise_nm in enumerate(
                    truth.noise_per_measurement(config.hardware.n_measurements), start=1
                )
            },
        },
    )
