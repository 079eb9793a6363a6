"""The command telemetry: what telemetry or a record holds, and telemetry written of it."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict

import numpy as np

from lbt_synth.cli import loop_records
from lbt_synth.cli.arguments import given_options
from lbt_synth.cli.loop_inputs import choose_unit
from lbt_synth.cli.output import Report, write_telemetry
from lbt_synth.errors import ProblemError
from lbt_synth.files import Telemetry, load_telemetry
from lbt_synth.files.telemetry.store import require_telemetry_name
from lbt_synth.files.telemetry.telemetry import LAYERS
from lbt_synth.identification.records.from_file import is_telemetry, telemetry_of_record
from lbt_synth.storage.atomic_files import require_writable
from lbt_synth.storage.display_unit import shown_unit
from lbt_synth.storage.rows import Facts, fact, fact_table, facts, json_record, json_units
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray


def run(arguments: Namespace) -> Report:
    """Show telemetry, or a record as telemetry, and write it."""
    output = arguments.output
    if output is None and (arguments.format or arguments.precision):
        raise ProblemError("--format and --precision are of what -o writes; give -o FILE.")
    if output is not None:
        require_telemetry_name(output, arguments.format)
        named = given_options(arguments, "file", "commands")
        require_writable(output, inputs=list(named.values()))
    notes: list[str] = []
    if is_telemetry(arguments.file) and not loop_records.is_read_anew(arguments):
        telemetry = load_telemetry(arguments.file)
    else:
        record = loop_records.require_series(loop_records.load_series(arguments), "telemetry holds")
        telemetry = telemetry_of_record(record)
        notes = [
            f"note: {record.health.summary()}",
            *(f"note: {note}" for note in record.health.notes),
        ]
    choose_unit(arguments, telemetry.diameter_m)
    report = _describe_telemetry(telemetry)
    report.data["file"] = arguments.file
    report.notes += notes
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
    mirror = telemetry.mirror
    what = _loop_facts(telemetry)
    mirror_record = None if mirror is None else asdict(mirror)
    report = Report(
        data={
            **json_record(what),
            "frames": telemetry.frames,
            "modes": telemetry.modes,
            "arrays": {name: list(array.shape) for name, array, _ in arrays},
            "units": json_units(what) | units,
            "rms": rms,
            "integrator_gains": telemetry.integrator_gains,
            "metadata": dict(telemetry.metadata),
            "mirror": mirror_record,
            "mirror_taps": telemetry.mirror_taps,
            "convention": telemetry.convention,
        }
    )
    seconds = telemetry.frames / telemetry.frame_rate_hz
    report.verdict.append(
        f"A loop of {count_text(telemetry.modes, 'mode')} at {telemetry.frame_rate_hz:g} Hz, for "
        f"{seconds:.6g} s ({telemetry.frames} frames)."
    )
    report.add_table(
        "What the file holds",
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
    report.tables.append(fact_table("Loop", what))
    more = {f"mirror, {name}": value for name, value in (mirror_record or {}).items()}
    more |= telemetry.metadata
    if more:
        report.add_table("What else the file says", ("name", "value"), more.items())
    return report


def _loop_facts(telemetry: Telemetry) -> Facts:
    """Return what telemetry says of the loop that it is from."""
    controller = telemetry.controller
    return facts(
        name=fact(telemetry.name, "system"),
        frame_rate_hz=fact(telemetry.frame_rate_hz, "frame rate", unit="Hz"),
        delay_frames=fact(telemetry.delay_frames, "total delay", unit="frames"),
        sensor_gain=fact(telemetry.sensor_gain, "sensor gain"),
        controller_name=fact(telemetry.controller_name, "controller"),
        controller_digest=fact(telemetry.controller_digest, "gain file, SHA-256"),
        strehl=fact(telemetry.strehl, "Strehl ratio"),
        imaging_wavelength_um=fact(
            telemetry.imaging_wavelength_um, "imaging wavelength", unit="um"
        ),
        psf_pixel_mas=fact(telemetry.psf_pixel_mas, "pixel of the image", unit="mas"),
        diameter_m=fact(telemetry.diameter_m, "telescope diameter", unit="m"),
        obstruction=fact(telemetry.obstruction, "central obstruction"),
        seed=fact(telemetry.seed, "seed"),
        controller_states=fact(controller and controller.n_states, "states of the controller"),
    )


def _rms(series: FloatArray) -> float:
    """Return the root of the mean over frames of the sum of squares over columns."""
    return float(np.sqrt(np.sum(np.nanmean(series**2, axis=0))))
