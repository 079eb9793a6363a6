"""The command simulate: the loop in the time domain, whose sensors may fail on the way."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lbt_synth.cli.arguments import given_options, input_files, refuse_options
from lbt_synth.cli.loop_inputs import difference_notes, load_designs, load_shown
from lbt_synth.cli.output import BRIEF_SENTENCES, Report
from lbt_synth.cli.telemetry import write_telemetry
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import GainFileError, ProblemError, UnstableLoopError
from lbt_synth.files import telemetry_from_simulation
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.loop import ClosedLoop
from lbt_synth.loop.budget import residual_spectrum
from lbt_synth.loop.simulation import READINGS, Drop, Segment, Simulation
from lbt_synth.models import Truth
from lbt_synth.report.figures.records import sensor_failure_figure, simulation_figure
from lbt_synth.report.screen import say_references, say_runs
from lbt_synth.storage.array_file import fits_bytes
from lbt_synth.storage.atomic_files import require_ending, require_writable, write_atomically
from lbt_synth.storage.input_files import file_sha256
from lbt_synth.storage.rows import Facts
from lbt_synth.storage.words import count_text, unstable_text
from lbt_synth.studies.runs import DesignRun, run_design

_TIME = r"(\d+\.?\d*)s?"
_DROP = re.compile(rf"([^@]+)@{_TIME}(?:\.\.{_TIME})?(?::({'|'.join(READINGS)}))?")
_SPECTRUM_STEP_HZ = 0.2  # at which MASTSEL 1.5 reads a spectrum for TIPTOP; P3 1.6 takes half of it
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


def run_simulate(arguments: Namespace) -> Report:
    """Close the loop in the time domain, beside the exact answer; sensors may fail on the way."""
    if arguments.telemetry is not None:
        require_telemetry_name(arguments.telemetry)
    if arguments.spectrum is not None:
        require_ending(arguments.spectrum, "a spectrum", [".fits"])
    outputs = given_options(arguments, "telemetry", "spectrum").values()
    require_writable(*outputs, inputs=input_files(arguments))
    if (count := len(arguments.gains)) > 1:
        single = ("output", "telemetry", "spectrum", "drop")
        refuse_options(arguments, single, f"goes with one gain file; got {count}")
    config = load_shown(arguments)
    truth = config.truth
    if arguments.sensor_gain is not None:
        truth = replace(truth, sensor_gain=arguments.sensor_gain / config.sensor_gain)
    designs = load_designs(arguments.gains, config)
    if arguments.spectrum is not None:  # what does not fit is refused before any run
        (design,) = designs.values()
        loop = design.close(config.hardware, sensor_gain=truth.sensor_gain)
        spectrum = tiptop_spectrum(loop, truth)
    runs, unstable = list[DesignRun](), dict[str, UnstableLoopError]()
    for name, design in designs.items():
        try:
            runs.append(_run(arguments, name, design, truth, config))
        except UnstableLoopError as error:
            unstable[name] = error
            if len(unstable) == count:
                raise
    report = _describe_runs(runs, unstable, truth, config)
    design, (_, simulation, segments, _) = next(iter(designs.values())), runs[0]
    report.figure = lambda: _draw(design, simulation, segments)
    if arguments.telemetry is not None:
        noise_nm = truth.noise_per_measurement(config.hardware.n_measurements).tolist()
        noise = {f"noise_nm_{i}": value for i, value in enumerate(noise_nm, start=1)}
        recorded = telemetry_from_simulation(
            simulation,
            config.hardware,
            sensor_gain=truth.sensor_gain,
            imaging=config.imaging,
            metadata={
                "controller": design.method,
                "gain_file_sha256": file_sha256(arguments.gains[0], GainFileError),
                "case": 0,
                "cases": len(simulation.commands),
                **noise,
            },
        )
        write_telemetry(report, arguments.telemetry, recorded)
    if arguments.spectrum is not None:
        report.note_written(write_atomically(arguments.spectrum, spectrum))
    return report


def tiptop_spectrum(loop: ClosedLoop, truth: Truth) -> bytes:
    """Return the spectrum of a residual as TIPTOP's windPsdFile: rows of frequency, tip, tilt."""
    if (modes := loop.hardware.modes) > 2:
        raise ProblemError(f"--spectrum takes a loop of tip and tilt; got {modes} modes.")
    frequency_hz, density = residual_spectrum(loop, truth, _SPECTRUM_STEP_HZ)
    rows = np.zeros((3, frequency_hz.size + 1))  # from 0 Hz
    rows[0, 1:], rows[1 : 1 + modes, 1:] = frequency_hz, density.T
    cards = {"BUNIT": ("nm^2/Hz", "of rows 2 and 3: tip and tilt, one-sided")}
    return fits_bytes(cards, {}, primary_data=rows)


def _run(
    arguments: Namespace, name: str, design: Design, truth: Truth, config: Config
) -> DesignRun:
    drops = _parse_drops(arguments, name, design)
    differences = difference_notes(config, {name: design})
    how: dict[str, Any] = _choose_sizes(arguments, config, drops)
    how |= {"drops": drops, "stroke": arguments.stroke}
    how["estimates"] = arguments.form == "estimator"
    try:
        run = run_design(name, design, truth, config, **how)
    except UnstableLoopError as error:
        why = " ".join([f"{name}: {error}", *differences])
        raise UnstableLoopError(why, spectral_radius=error.spectral_radius) from error
    return run._replace(notes=[*(f"note: {note}" for note in run.notes), *differences])


def _describe_runs(
    runs: Sequence[DesignRun], unstable: Mapping[str, Exception], truth: Truth, config: Config
) -> Report:
    """Return a line for each gain file, and the parts between failures of a single one."""
    rows, (_, first, segments, _) = [row for row, *_ in runs], runs[0]
    cases, frames = first.residual_nm.shape[:2]
    report = Report(data={"frames": frames, "cases": cases, "seed": first.seed})
    report.data["wavelength_um"] = config.imaging.wavelength_um
    report.data["sensor_gain"] = config.sensor_gain * truth.sensor_gain
    said = say_runs(rows)
    if unstable:
        report.verdict.append(f"{unstable_text(list(unstable))} at this sensor gain.")
        report.notes += [f"note: {error}" for error in unstable.values()]
        rows += [Facts(rows[0].columns, {"design": name}) for name in unstable]
    most = BRIEF_SENTENCES - 1 - len(report.verdict)
    report.verdict += [*said[:most], *say_references(truth, config), *said[most:]]
    caption = f"{count_text(cases, 'run')} of {frames} frames; {config.imaging.label}"
    report.add_rows("designs", caption, rows)
    report.rows, report.without = rows, ("cases_residual_nm", "cases_strehl")
    if segments:
        caption = "Simulated between failures and returns of sensors"
        report.add_rows("segments", caption, [row for _, row in segments])
        report.tables.reverse()
    report.notes += dict.fromkeys(note for *_, notes in runs for note in notes)
    if truth.drifts:
        report.notes.append(
            "note: a vibration drifts, so there is no exact answer beside the simulation."
        )
    return report


def _draw(design: Design, simulation: Simulation, segments: Sequence[tuple[Segment, Facts]]) -> Any:
    if not design.other_sensors:
        title = f"{design.method}: the first second, and spectra of all runs"
        return simulation_figure(simulation, title=title)
    places, exact_nm = [place for place, _ in segments], [row.exact_nm for _, row in segments]
    return sensor_failure_figure(
        simulation, title=design.method, segments=places, exact_nm=exact_nm
    )


def _parse_drops(arguments: Namespace, name: str, design: Design) -> list[Drop]:
    """Return the sensors that fail; refuse options that the design has nothing for."""
    if not design.other_sensors and arguments.drop:
        raise ProblemError(
            "--drop goes with a design of several sensors: give sensors in the configuration and "
            f"design again. {name} has the loop's own sensor alone."
        )
    if design.other_sensors:
        own_alone = ("stroke", "form", "telemetry")
        refuse_options(arguments, own_alone, "goes with a design of the loop's own sensor alone")
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
