"""Commands of the end-to-end simulation: e2e, e2e-table."""

from __future__ import annotations

import hashlib
import json
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lbt_synth.cli.output import Report, TableText, counting, fixed, plain
from lbt_synth.cli.output_files import made_directory, records_csv
from lbt_synth.cli.simulate import named_designs
from lbt_synth.config import load_config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, load_gain, save_telemetry
from lbt_synth.interop import Calibration, EndToEndRun, EndToEndSetup, calibrate
from lbt_synth.interop.specula.cases import summary
from lbt_synth.interop.specula.optics import specula_version
from lbt_synth.report.figures import end_to_end_figure
from lbt_synth.report.figures.paper import table_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.atomic_files import refuse_replacing, write_atomically
from lbt_synth.studies import EndToEndEntry
from lbt_synth.studies.paper.end_to_end import all_cases, modal_distance, plan_tables, run_tables

_RUN = ("run.png", "telemetry.fits", "summary.json")
_TABLES = {"II": ("table_ii.csv",), "III": ("table_iii.csv", "table_iii.png", "table_iii.pdf")}


def end_to_end(arguments: Namespace) -> Report:
    """Close the loop of a gain file end to end, and write what came of it."""
    outputs = [Path(arguments.output) / name for name in _RUN]
    refuse_replacing(outputs, [arguments.config, arguments.gain])
    setup = _setup(arguments)
    design = load_gain(arguments.gain)
    setup.controller(design)  # refuses a filter of another loop before any work
    version = specula_version()
    made_directory(arguments.output)
    figure_file, telemetry_file, summary_file = outputs
    calibration = _calibrated(setup, arguments)
    total = setup.frames + setup.settle_frames
    with counting(total=total, what="frames", quiet=arguments.json) as count:
        run = setup.run(design, calibration=calibration, cache=arguments.cache, progress=count)
    figures = summary(run)
    inverse = calibration.reconstructor
    data: dict[str, Any] = {
        "gain": str(arguments.gain),
        "method": design.method,
        "specula": version,
        "pixels": setup.system.pixels,
        "frames": run.frames,
        "settle_frames": run.settle_frames,
        "seed": run.seed,
        **figures,
        "condition_number": inverse.condition_number,
        "milliseconds_a_frame": 1e3 * run.seconds / total,
    }
    files = [
        save_figure(end_to_end_figure(run), figure_file),
        save_telemetry(
            telemetry_file,
            _telemetry(run, design, calibration, arguments),
            precision="float32",
        ),
        write_atomically(summary_file, json.dumps(plain(data), indent=1).encode() + b"\n"),
    ]
    data["files"] = [str(path) for path in files]
    return Report(
        data=data,
        tables=[
            TableText(
                title=f"End to end: {run.system.modes} modes, {run.frames} frames after "
                f"{run.settle_frames}, seed {run.seed}",
                headings=("figure", "value", "unit"),
                rows=[
                    *_figures(run, figures),
                    ("condition of the reconstructor", f"{inverse.condition_number:.1f}", ""),
                    ("time a frame", f"{data['milliseconds_a_frame']:.1f}", "ms"),
                ],
            )
        ],
        notes=[f"written: {path}" for path in files],
    )


def _figures(run: EndToEndRun, figures: dict[str, Any]) -> list[tuple[str, str, str]]:
    wavelength = run.system.imaging_wavelength_um
    return [
        (
            f"Strehl ratio at {wavelength:g} um",
            f"{100 * run.strehl:.2f} +- {fixed(100 * run.strehl_error, 2)}",
            "%",
        ),
        ("the same without tip and tilt", f"{100 * run.other_modes_strehl:.2f}", "%"),
        ("tip", f"{figures['tip_rms_nm']:.1f}", "nm rms"),
        ("tilt", f"{figures['tilt_rms_nm']:.1f}", "nm rms"),
        ("all other modes", f"{figures['other_modes_rms_nm']:.1f}", "nm rms"),
        (
            "optical gain of tip and tilt",
            f"{run.tip_tilt_gain:.3f} +- {run.tip_tilt_gain_error:.3f}",
            "",
        ),
        ("what it leaves of their measurements", f"{run.tip_tilt_noise_nm:.1f}", "nm rms"),
    ]


def end_to_end_table(arguments: Namespace) -> Report:
    """Run Tables II and III of the paper end to end, or what is missing of them."""
    folder = Path(arguments.output)
    written = [folder / name for number in arguments.tables for name in _TABLES[number]]
    refuse_replacing(written, [arguments.config, *arguments.gains])
    setup = _setup(arguments)
    designs = named_designs(arguments.gains)
    if min(arguments.seeds, arguments.row_seeds, arguments.jobs) < 1:
        raise ProblemError("--seeds, --row-seeds and --jobs must be at least 1.")
    specula_version()
    rows = plan_tables(
        setup,
        {_case_name(name): design for name, design in designs.items()},
        seeds=range(setup.seed, setup.seed + arguments.seeds),
        row_seeds=range(setup.seed, setup.seed + arguments.row_seeds),
        tables=arguments.tables,
    )
    total = len(all_cases(rows))
    made_directory(folder)
    results = made_directory(folder / "cases")
    _calibrated(setup, arguments)
    with counting(total=total, what="runs", quiet=arguments.json) as count:
        table = run_tables(
            setup, rows, results, jobs=arguments.jobs, cache=arguments.cache, progress=count
        )
    files = [
        write_atomically(
            folder / _TABLES[number][0],
            records_csv([_record(entry) for entry in table if entry.table == number]),
        )
        for number in arguments.tables
    ]
    distances: dict[str, float] = {}
    if "III" in arguments.tables:
        figure = table_figure(table)
        files += [save_figure(figure, folder / name) for name in _TABLES["III"][1:]]
        methods = dict.fromkeys(e.method for e in table if e.table == "III")
        distances = {method: modal_distance(table, method) for method in methods}
    return Report(
        data={
            "entries": [_record(entry) for entry in table],
            "modal_distance_points": distances,
            "runs": total,
            "files": [str(path) for path in files],
        },
        tables=[_table(table, number) for number in arguments.tables],
        notes=[
            *(
                f"Table III, {method}: end to end less modal {points:.1f} points rms"
                for method, points in distances.items()
            ),
            *(f"written: {path}" for path in files),
        ],
    )


def _setup(arguments: Namespace) -> EndToEndSetup:
    setup = load_config(arguments.config).end_to_end
    if arguments.pixels is not None:
        setup = replace(setup, system=replace(setup.system, pixels=arguments.pixels))
    changes = {
        name: getattr(arguments, name)
        for name in ("frames", "settle_frames", "seed")
        if getattr(arguments, name) is not None
    }
    return replace(setup, **changes)


def _calibrated(setup: EndToEndSetup, arguments: Namespace) -> Calibration:
    with counting(total=setup.system.modes, what="calibration", quiet=arguments.json) as count:
        return calibrate(setup.system, cache=arguments.cache, progress=count)


def _case_name(name: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in Path(name).stem)


def _record(entry: EndToEndEntry) -> dict[str, Any]:
    return {
        "table": entry.table,
        "row": entry.label,
        "method": entry.method,
        "error_hz": entry.error_hz,
        "strehl_percent": entry.strehl,
        "scatter_points": entry.scatter,
        "seeds": len(entry.strehls),
        "paper_strehl_percent": entry.paper,
        "modal_strehl_percent": entry.modal,
        "optical_gain": entry.optical_gain,
        "tip_rms_nm": entry.tip_rms_nm,
        "tilt_rms_nm": entry.tilt_rms_nm,
        "other_modes_strehl_percent": entry.other_modes,
    }


def _table(table: Sequence[EndToEndEntry], number: str) -> TableText:
    return TableText(
        title=f"Table {number} end to end: Strehl ratio [%] at 2.2 um",
        headings=(
            "row",
            "method",
            "end to end",
            "scatter",
            "seeds",
            "paper",
            "modal",
            "optical gain",
            "tip [nm]",
            "tilt [nm]",
            "other modes [%]",
        ),
        rows=[
            (
                entry.label,
                entry.method,
                f"{entry.strehl:.1f}",
                fixed(entry.scatter, 1),
                len(entry.strehls),
                fixed(entry.paper, 1),
                f"{entry.modal:.1f}",
                f"{entry.optical_gain:.3f}",
                f"{entry.tip_rms_nm:.0f}",
                f"{entry.tilt_rms_nm:.0f}",
                f"{entry.other_modes:.1f}",
            )
            for entry in table
            if entry.table == number
        ],
    )


def _telemetry(
    run: EndToEndRun, design: Design, calibration: Calibration, arguments: Namespace
) -> Telemetry:
    system = run.system
    return Telemetry(
        name=f"end to end, {system.modes} modes",
        frame_rate_hz=system.frame_rate_hz,
        delay_frames=system.hardware.delay_frames,
        mirror=system.hardware.mirror,
        commands=run.commands,
        measurements=run.measurements,
        residual_nm=run.residual_nm,
        psf=run.psf,
        psf_pixel_mas=run.psf_pixel_mas,
        imaging_wavelength_um=system.imaging_wavelength_um,
        strehl=min(run.strehl, 1.0),
        sensor_gain=run.tip_tilt_gain if run.tip_tilt_gain > 0 else None,
        controller_name=f"mixed: tip and tilt by {design.method}, integrators for the rest",
        controller_digest=hashlib.sha256(Path(arguments.gain).read_bytes()).hexdigest(),
        diameter_m=system.diameter_m,
        obstruction=system.obstruction,
        seed=run.seed,
        metadata={
            "simulator": f"SPECULA {specula_version()}",
            "gain_file": Path(arguments.gain).name,
            "pixels": system.pixels,
            "settle_frames": run.settle_frames,
            "calibration": calibration.key,
            "sensor_gain_is": "optical gain of tip and tilt, measured in the loop",
        },
    )
