"""The command simulate for a design of several sensors, some of which may fail on the way."""

from __future__ import annotations

import re
from argparse import Namespace

import numpy as np

from lbt_synth.cli.argument_kinds import given_options
from lbt_synth.cli.loop_inputs import loop_difference_notes, truth_at_sensor_gain
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.config import Config
from lbt_synth.design.fusion.fused_filter import FusedFilter
from lbt_synth.errors import ProblemError
from lbt_synth.loop import residual_budget, strehl
from lbt_synth.loop.fusion.simulation import READINGS, Drop
from lbt_synth.report.figures import sensor_failure_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.words import count_text
from lbt_synth.studies.sensor_failures import run_failures

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


def run_fused(arguments: Namespace, config: Config, design: FusedFilter) -> Report:
    """Run the loop of a design of several sensors."""
    for option in ("stroke", "form", "telemetry"):
        if getattr(arguments, option) is not None:
            raise ProblemError(f"--{option} goes with a design of the loop's own sensor alone.")
    drops = [parse_drop(text) for text in arguments.drop or ()]
    truth = truth_at_sensor_gain(config, arguments.sensor_gain)
    loop = design.close(config.hardware, sensor_gain=truth.sensor_gain)
    loop.require_stable()
    settings, rate = config.settings.simulation, config.hardware.frame_rate_hz
    given = given_options(arguments, "frames", "cases", "seed")
    last_s = max((t for d in drops for t in (d.start_s, d.end_s) if np.isfinite(t)), default=0.0)
    usual = max(settings.frames, int(np.ceil((last_s + _AFTER_S) * rate)) if drops else 0)
    sizes = {"frames": usual, "cases": settings.cases, "seed": settings.seed} | given
    if drops and last_s * rate >= sizes["frames"]:
        raise ProblemError(
            f"--frames must reach beyond the last --drop, {last_s:g} s or {last_s * rate:.0f} "
            f"frames; got {sizes['frames']}."
        )
    with show_spinner("closing the loop", quiet=arguments.json):
        found = run_failures(design, config, truth, drops, **sizes)
    report = Report(
        data={
            "residual_nm": found.simulation.rms_nm,
            "frames": sizes["frames"],
            "cases": sizes["cases"],
            "seed": sizes["seed"],
            "wavelength_um": config.imaging.wavelength_um,
        }
    )
    runs = count_text(sizes["cases"], "run")
    caption = f"{design.method} in the loop: {runs}; {config.imaging.label}"
    report.add_rows("segments", caption, found.rows(config.imaging))
    if not truth.drifts:
        ratio = strehl(residual_budget(loop, truth), config.imaging)
        report.data["strehl_exact"] = ratio
        report.notes.append(f"Strehl ratio with all sensors, exact: {100 * ratio:.2f} %")
    report.notes += loop_difference_notes(config, design)
    if arguments.output is not None:
        figure = sensor_failure_figure(
            found.simulation, found.segments, found.exact_nm, title=design.method
        )
        report.note_written(save_figure(figure, arguments.output))
    return report
