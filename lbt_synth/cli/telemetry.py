"""The command telemetry: what a telemetry file holds, and other formats of it."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict

import numpy as np

from lbt_synth.cli.display import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import write_telemetry
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, load_telemetry
from lbt_synth.files.telemetry.fields import LAYERS
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import column, fact_table, fill_row, json_record, json_units, table_row
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray


@table_row
class TelemetryFacts:
    """The loop that telemetry is from."""

    name: str = column("system")
    frame_rate_hz: float = column("frame rate", unit="Hz")
    delay_frames: float = column("total delay", unit="frames")
    sensor_gain: float | None = column("sensor gain")
    controller_name: str | None = column("controller")
    controller_digest: str | None = column("gain file, SHA-256")
    strehl: float | None = column("Strehl ratio")
    imaging_wavelength_um: float | None = column("imaging wavelength", unit="um")
    psf_pixel_mas: float | None = column("pixel of the image", unit="mas")
    diameter_m: float | None = column("telescope diameter", unit="m")
    obstruction: float | None = column("central obstruction")
    seed: int | None = column("seed")
    controller_states: int | None = column("states of the controller")


def run(arguments: Namespace) -> Report:
    """Show a telemetry file, and write it in another format."""
    output = arguments.output
    if output is None and (arguments.format or arguments.precision):
        raise ProblemError("--format and --precision are of what -o writes; give -o FILE.")
    if output is not None:
        require_telemetry_name(output, arguments.format)
        require_writable(output, inputs=[arguments.file])
    telemetry = load_telemetry(arguments.file)
    choose_unit(arguments, telemetry.diameter_m)
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
    units = {name: layer.unit_in(telemetry) for name, _, layer in arrays}
    controller, mirror = telemetry.controller, telemetry.mirror
    facts = fill_row(
        TelemetryFacts,
        telemetry,
        controller_states=None if controller is None else controller.n_states,
    )
    mirror_record = None if mirror is None else asdict(mirror)
    report = Report(
        data={
            **json_record(facts),
            "frames": telemetry.frames,
            "modes": telemetry.modes,
            "arrays": {name: list(array.shape) for name, array, _ in arrays},
            "units": json_units(facts) | units,
            "rms": rms,
            "integrator_gains": telemetry.integrator_gains,
            "metadata": dict(telemetry.metadata),
            "mirror": mirror_record,
            "mirror_taps": telemetry.mirror_taps,
            "convention": telemetry.convention,
        }
    )
    seconds = telemetry.frames / telemetry.frame_rate_hz
    report.add_table(
        f"{telemetry.frames} frames, {seconds:.6g} s, {count_text(telemetry.modes, 'mode')}",
        ("array", "shape", "axes", "unit", "rms"),
        [
            (
                name,
                " x ".join(map(str, array.shape)),
                layer.axes,
                shown_unit(units[name])[0],
                shown_unit(units[name])[1] * rms[name] if name in rms else None,
            )
            for name, array, layer in arrays
        ],
    )
    report.tables.append(fact_table("Loop", facts))
    more = {f"mirror, {name}": value for name, value in (mirror_record or {}).items()}
    more |= telemetry.metadata
    if more:
        report.add_table("What else the file says", ("name", "value"), more.items())
    return report


def _rms(series: FloatArray) -> float:
    """Return the root of the mean over frames of the sum of squares over columns."""
    return float(np.sqrt(np.sum(np.mean(series**2, axis=0))))
