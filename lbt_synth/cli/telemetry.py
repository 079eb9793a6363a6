"""The command telemetry: what a telemetry file holds, and other formats of it."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from typing import Any

import numpy as np

from lbt_synth.cli.output import Facts, Report, TableText, fact_table
from lbt_synth.cli.output_files import write_telemetry
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, load_telemetry
from lbt_synth.files.telemetry.fields import LAYERS
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.validation import FloatArray

_FACTS = (  # words, field, unit
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


def run(arguments: Namespace) -> Report:
    """Show a telemetry file, and write it in another format."""
    output = arguments.output
    if output is None and (arguments.format or arguments.precision):
        raise ProblemError("--format and --precision are of what -o writes; give -o FILE.")
    if output is not None:
        require_telemetry_name(output, arguments.format)
        require_writable(output, inputs=[arguments.file])
    telemetry = load_telemetry(arguments.file)
    report = _describe_telemetry(telemetry)
    report.data["file"] = arguments.file
    if "timing" not in telemetry.metadata:  # of another program
        report.notes.append(telemetry.convention)
    if output is not None:
        precision = arguments.precision or "float64"
        write_telemetry(
            report, output, telemetry, key="output", kind=arguments.format, precision=precision
        )
    return report


def _describe_telemetry(telemetry: Telemetry) -> Report:
    """Describe the arrays in a telemetry file, and the loop that they are from."""
    arrays = [
        (layer.field, getattr(telemetry, layer.field), layer)
        for layer in LAYERS.values()
        if getattr(telemetry, layer.field) is not None
    ]
    rms = {
        name: _rms(array) for name, array, layer in arrays if layer.is_series and name != "times_s"
    }
    rows = [
        (
            name,
            " x ".join(map(str, array.shape)),
            layer.axes,
            layer.unit_in(telemetry),
            rms.get(name),
        )
        for name, array, layer in arrays
    ]
    facts: Facts = [
        (word, getattr(telemetry, name), unit)
        for word, name, unit in _FACTS
        if getattr(telemetry, name) not in (None, "")
    ]
    if telemetry.controller is not None:
        facts.append(("states of the controller", telemetry.controller.n_states, ""))
    if telemetry.mirror is not None:
        facts += [
            (f"mirror, {name}", value, "") for name, value in asdict(telemetry.mirror).items()
        ]
    facts += [(key, value, "") for key, value in telemetry.metadata.items()]
    data: dict[str, Any] = {name: getattr(telemetry, name) for _, name, _ in _FACTS}
    data |= {
        "frames": telemetry.frames,
        "modes": telemetry.modes,
        "arrays": {name: list(array.shape) for name, array, _ in arrays},
        "units": {name: layer.unit_in(telemetry) for name, _, layer in arrays},
        "rms": rms,
        "controller_states": None
        if telemetry.controller is None
        else telemetry.controller.n_states,
        "integrator_gains": telemetry.integrator_gains,
        "metadata": dict(telemetry.metadata),
        "mirror": None if telemetry.mirror is None else asdict(telemetry.mirror),
        "mirror_taps": telemetry.mirror_taps,
        "convention": telemetry.convention,
    }
    seconds = telemetry.frames / telemetry.frame_rate_hz
    return Report(
        data=data,
        tables=[
            TableText(
                title=f"{telemetry.frames} frames, {seconds:.6g} s, {telemetry.modes} "
                f"mode{'s' if telemetry.modes > 1 else ''}",
                headings=("array", "shape", "axes", "unit", "rms"),
                rows=rows,
            ),
            fact_table("Loop", facts),
        ],
    )


def _rms(series: FloatArray) -> float:
    """Return the root of the mean over frames of the sum of squares over columns."""
    return float(np.sqrt(np.sum(np.mean(series**2, axis=0))))
