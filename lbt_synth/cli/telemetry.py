"""Telemetry at the command line: what a file holds, other formats, that of a simulation."""

from __future__ import annotations

import hashlib
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.cli.output import Report, TableText
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, load_telemetry, save_telemetry, telemetry_of
from lbt_synth.files.telemetry.aot import losses
from lbt_synth.files.telemetry.layout import LAYERS
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.loop import Simulation
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.validation import FloatArray

_FACTS = (
    ("system", "name", ""),
    ("frame rate", "frame_rate_hz", "Hz"),
    ("total delay", "delay_frames", "frames"),
    ("sensor gain", "sensor_gain", ""),
    ("controller", "controller_name", ""),
    ("gain file, SHA-256", "controller_digest", ""),
    ("Strehl ratio", "strehl", ""),
    ("imaging wavelength", "imaging_wavelength_um", "um"),
    ("pixel of the image", "psf_pixel_mas", "mas"),
    ("telescope diameter", "diameter_m", "m"),
    ("central obstruction", "obstruction", ""),
    ("seed", "seed", ""),
)


def telemetry(arguments: Namespace) -> Report:
    """Show a telemetry file, and write it in another format."""
    output, kind = arguments.output, None
    if output is None and (arguments.format or arguments.precision):
        raise ProblemError("--format and --precision are of what -o writes; give -o FILE.")
    if output is not None:
        kind = require_telemetry_name(output, arguments.format)
        require_writable(output, inputs=[arguments.file])
    seen = load_telemetry(arguments.file)
    report = _description(seen)
    report.data["file"] = arguments.file
    if "timing" not in seen.metadata:  # of another program
        report.notes.append(seen.convention)
    if kind is not None:
        precision = arguments.precision or "float64"
        path = save_telemetry(output, seen, format=kind, precision=precision)
        report.data["output"] = str(path)
        _note_written(report, path, seen, kind)
    return report


def write_first_case(
    report: Report, output: str, run: Simulation, config: Config, design: Design, gain: str
) -> None:
    """Write the telemetry of case 0, and note it in the report."""
    truth = config.truth
    seen = telemetry_of(
        run,
        config.hardware,
        sensor_gain=truth.sensor_gain,
        design=design,
        controller_digest=hashlib.sha256(Path(gain).read_bytes()).hexdigest(),
        imaging=config.imaging,
        metadata={
            "case": 0,
            "cases": len(run.commands),
            **_one_or_each("noise_nm", truth.noise_nm),
            **_one_or_each("model_sensor_gain", config.settings.model.sensor_gain),
        },
    )
    path = save_telemetry(output, seen)
    report.data["telemetry"] = str(path)
    _note_written(report, path, seen, require_telemetry_name(output), of="of case 0")


def _one_or_each(name: str, value: Any) -> dict[str, float]:
    """Return one number under its name, or a list by ``name_1``, ``name_2``, ..."""
    if np.ndim(value) == 0:
        return {name: float(value)}
    return {f"{name}_{i}": float(each) for i, each in enumerate(value, start=1)}


def _note_written(report: Report, path: Path, seen: Telemetry, kind: str, of: str = "") -> None:
    word = f"telemetry {of}".strip()
    report.notes.append(f"written: {path} ({word})")
    lost = losses(seen) if kind == "aot" else ()
    report.data["lost"] = list(lost)
    if lost:
        report.notes.append(f"note: the AOT standard has no place for {', '.join(lost)}.")


def _description(seen: Telemetry) -> Report:
    """Tables of what there is."""
    arrays = [
        (layer.field, getattr(seen, layer.field), layer)
        for layer in LAYERS.values()
        if getattr(seen, layer.field) is not None
    ]
    rms = {name: _rms(array) for name, array, layer in arrays if layer.series and name != "times_s"}
    rows = [
        (name, " x ".join(map(str, array.shape)), layer.axes, layer.unit_of(seen), rms.get(name))
        for name, array, layer in arrays
    ]
    facts: list[tuple[Any, ...]] = [
        (word, getattr(seen, name), unit)
        for word, name, unit in _FACTS
        if getattr(seen, name) not in (None, "")
    ]
    if seen.controller is not None:
        facts.append(("states of the controller", seen.controller.n_states, ""))
    if seen.mirror is not None:
        facts += [(f"mirror, {name}", value, "") for name, value in asdict(seen.mirror).items()]
    facts += [(key, value, "") for key, value in seen.metadata.items()]
    data: dict[str, Any] = {name: getattr(seen, name) for _, name, _ in _FACTS}
    data |= {
        "frames": seen.frames,
        "modes": seen.modes,
        "arrays": {name: list(array.shape) for name, array, _ in arrays},
        "units": {name: layer.unit_of(seen) for name, _, layer in arrays},
        "rms": rms,
        "controller_states": None if seen.controller is None else seen.controller.n_states,
        "integrator_gains": seen.integrator_gains,
        "metadata": dict(seen.metadata),
        "mirror": None if seen.mirror is None else asdict(seen.mirror),
        "mirror_taps": seen.mirror_taps,
        "convention": seen.convention,
    }
    seconds = seen.frames / seen.frame_rate_hz
    return Report(
        data=data,
        tables=[
            TableText(
                title=f"{seen.frames} frames, {seconds:.6g} s, {seen.modes} "
                f"mode{'s' if seen.modes > 1 else ''}",
                headings=("array", "shape", "axes", "unit", "rms"),
                rows=rows,
            ),
            TableText(title="Loop", headings=("quantity", "value", "unit"), rows=facts),
        ],
    )


def _rms(series: FloatArray) -> float:
    """Root of the mean over frames of the sum of squares over columns."""
    return float(np.sqrt(np.sum(np.mean(series**2, axis=0))))
