"""The command end-to-end: a gain file in the loop with a pyramid, a mirror and moving air."""

from __future__ import annotations

import hashlib
import json
from argparse import Namespace
from pathlib import Path
from typing import Any

from lbt_synth.cli.end_to_end_setup import calibrate_setup, load_setup
from lbt_synth.cli.output import Report, TableText, format_fixed, json_value
from lbt_synth.cli.output_files import make_directory
from lbt_synth.cli.progress import count_progress
from lbt_synth.design import Design
from lbt_synth.files import Telemetry, load_gain, save_telemetry
from lbt_synth.interop import Calibration, EndToEndRun
from lbt_synth.interop.specula.json_cases import summarise_run
from lbt_synth.interop.specula.optics import specula_version
from lbt_synth.report.figures import end_to_end_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.atomic_files import refuse_replacing, write_atomically

_FILES = ("run.png", "telemetry.fits", "summary.json")


def run(arguments: Namespace) -> Report:
    """Close the loop of a gain file end to end, and write a figure, telemetry and a summary."""
    outputs = [Path(arguments.output) / name for name in _FILES]
    refuse_replacing(outputs, [arguments.config, arguments.gain])
    setup = load_setup(arguments)
    design = load_gain(arguments.gain)
    setup.controller(design)  # refuses a filter of another loop before any work
    version = specula_version()
    make_directory(arguments.output)
    figure_file, telemetry_file, summary_file = outputs
    calibration = calibrate_setup(setup, arguments)
    total = setup.frames + setup.settle_frames
    with count_progress(total=total, what="frames", quiet=arguments.json) as count:
        loop_run = setup.run(design, calibration=calibration, cache=arguments.cache, progress=count)
    figures = summarise_run(loop_run)
    inverse = calibration.reconstructor
    data: dict[str, Any] = {
        "gain": str(arguments.gain),
        "method": design.method,
        "specula": version,
        "pixels": setup.system.pixels,
        "frames": loop_run.frames,
        "settle_frames": loop_run.settle_frames,
        "seed": loop_run.seed,
        **figures,
        "condition_number": inverse.condition_number,
        "milliseconds_a_frame": 1e3 * loop_run.seconds / total,
    }
    files = [
        save_figure(end_to_end_figure(loop_run), figure_file),
        save_telemetry(
            telemetry_file,
            _telemetry(loop_run, design, calibration, arguments),
            precision="float32",
        ),
        write_atomically(summary_file, json.dumps(json_value(data), indent=1).encode() + b"\n"),
    ]
    data["files"] = [str(path) for path in files]
    return Report(
        data=data,
        tables=[
            TableText(
                title=f"End to end: {loop_run.system.modes} modes, {loop_run.frames} frames after "
                f"{loop_run.settle_frames}, seed {loop_run.seed}",
                headings=("figure", "value", "unit"),
                rows=[
                    *_figure_rows(loop_run, figures),
                    ("condition of the reconstructor", f"{inverse.condition_number:.1f}", ""),
                    ("time per frame", f"{data['milliseconds_a_frame']:.1f}", "ms"),
                ],
            )
        ],
        notes=[f"written: {path}" for path in files],
    )


def _figure_rows(loop_run: EndToEndRun, figures: dict[str, Any]) -> list[tuple[str, str, str]]:
    wavelength = loop_run.system.imaging_wavelength_um
    return [
        (
            f"Strehl ratio at {wavelength:g} um",
            f"{100 * loop_run.strehl:.2f} +- {format_fixed(100 * loop_run.strehl_error, 2)}",
            "%",
        ),
        ("the same without tip and tilt", f"{100 * loop_run.other_modes_strehl:.2f}", "%"),
        ("tip", f"{figures['tip_rms_nm']:.1f}", "nm rms"),
        ("tilt", f"{figures['tilt_rms_nm']:.1f}", "nm rms"),
        ("all other modes", f"{figures['other_modes_rms_nm']:.1f}", "nm rms"),
        (
            "optical gain of tip and tilt",
            f"{loop_run.tip_tilt_gain:.3f} +- {loop_run.tip_tilt_gain_error:.3f}",
            "",
        ),
        ("what it leaves of their measurements", f"{loop_run.tip_tilt_noise_nm:.1f}", "nm rms"),
    ]


def _telemetry(
    loop_run: EndToEndRun, design: Design, calibration: Calibration, arguments: Namespace
) -> Telemetry:
    system = loop_run.system
    return Telemetry(
        name=f"end to end, {system.modes} modes",
        frame_rate_hz=system.frame_rate_hz,
        delay_frames=system.hardware.delay_frames,
        mirror=system.hardware.mirror,
        commands=loop_run.commands,
        measurements=loop_run.measurements,
        residual_nm=loop_run.residual_nm,
        psf=loop_run.psf,
        psf_pixel_mas=loop_run.psf_pixel_mas,
        imaging_wavelength_um=system.imaging_wavelength_um,
        strehl=min(loop_run.strehl, 1.0),
        sensor_gain=loop_run.tip_tilt_gain if loop_run.tip_tilt_gain > 0 else None,
        controller_name=f"mixed: tip and tilt by {design.method}, integrators for the rest",
        controller_digest=hashlib.sha256(Path(arguments.gain).read_bytes()).hexdigest(),
        diameter_m=system.diameter_m,
        obstruction=system.obstruction,
        seed=loop_run.seed,
        metadata={
            "simulator": f"SPECULA {specula_version()}",
            "gain_file": Path(arguments.gain).name,
            "pixels": system.pixels,
            "settle_frames": loop_run.settle_frames,
            "calibration": calibration.key,
            "sensor_gain_is": "optical gain of tip and tilt, measured in the loop",
        },
    )
