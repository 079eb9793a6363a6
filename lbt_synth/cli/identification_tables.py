"""What identify and auto print of a record and of the model identified from it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lbt_synth.cli.output import Report
from lbt_synth.identification import IdentifiedAxis, IdentifiedModel, LoopRecord, SpectrumRecord
from lbt_synth.identification.records.faults import HEADINGS
from lbt_synth.storage.rows import cell_text, column, fill_row, nm_column, row_table, table_row


def add_record(report: Report, record: LoopRecord | SpectrumRecord) -> None:
    """Add what a record holds, and what was found wrong with it."""
    if isinstance(record, SpectrumRecord):
        _add_spectra(report, record)
    else:
        _add_series(report, record)


def _add_spectra(report: Report, record: SpectrumRecord) -> None:
    f = record.frequency_hz
    report.data["record"] = {"kind": "spectrum", "frequencies": f.size, "notes": record.notes}
    report.add_table(
        f"Spectra of {_axes_text(record.axes)}",
        ("axis", "from [Hz]", "to [Hz]", "rms [nm]"),
        [
            (name, f[0], f[-1], f"{rms:.1f}")
            for name, rms in zip(_axis_names(record.axes), record.rms_nm, strict=True)
        ],
    )
    report.notes += [f"note: {note}" for note in record.notes]


def _add_series(report: Report, record: LoopRecord) -> None:
    health, names = record.health, _axis_names(record.axes)
    kind = "open loop" if record.commands is None else "closed loop"
    report.data["record"] = {
        "kind": kind,
        "frames": record.frames,
        "usable": health.usable,
        "frame_rate_hz": record.frame_rate_hz,
        "delay_frames": record.delay_frames,
        "findings": [asdict(found) for found in health.findings],
        "notes": health.notes,
    }
    text = f"{record.duration_s:.4g} s, {kind}, {_axes_text(record.axes)}"
    rows = [
        (fault, series, "both" if axis is None else names[axis], *rest)
        for fault, series, axis, *rest in health.rows()
    ]
    if rows:
        report.add_table(f"Record: {text}: {health.summary()}", HEADINGS, rows)
    else:
        report.notes.append(f"record: {text}; {health.summary()}")
    report.notes += [f"note: {note}" for note in health.notes]


def _axes_text(count: int) -> str:
    return "1 axis" if count == 1 else f"{count} axes"


def _axis_names(count: int) -> list[str]:
    return ["tip", "tilt"] if count == 2 else ["-"] * count


@table_row
class VibrationRow:
    """A vibration found on one axis."""

    axis: str = column("axis")
    frequency_hz: float = column("f", unit="Hz", format=".3f")
    frequency_error_hz: float = column("+-", unit="Hz", format=".2g")
    damping: str = column("damping")  # one that is not resolved has a bound, and no error
    damping_error: float | None = column("+-", format=".2g")
    rms_nm: float = nm_column("rms", format=".2f")
    rms_error_nm: float = column("+-", unit="nm", format=".2g")
    prominence: float = column("over the rest", format=".3g")
    origin: str = column("origin")


def add_model(report: Report, model: IdentifiedModel) -> None:
    """Add the tables of an identified model, its notes, and its numbers."""
    names = _axis_names(len(model.axes))
    named_axes = list(zip(names, model.axes, strict=True))
    report.add_table(
        "Turbulence, noise and sensor",
        ("quantity", "axis", "value", "error", "unit"),
        [
            (quantity, name, cell_text(value, digits), cell_text(error, ".2g"), unit)
            for name, axis in named_axes
            for quantity, value, digits, error, unit in _background(axis)
            if value is not None
        ],
    )
    lines = [
        fill_row(
            VibrationRow,
            line,
            axis=name,
            damping=f"{line.damping:.3g}" if line.resolved else f"< {line.damping:.2g}",
            damping_error=line.damping_error if line.resolved else None,
            origin=line.kind + ", announced" * line.announced,
        )
        for name, axis in named_axes
        for line in axis.parts
    ]
    if lines:
        report.tables.append(row_table("Vibrations", lines))
    else:
        report.notes.append("no vibration stands out of the turbulence and the noise.")
    report.notes += [marked_note(note) for note in model.notes]
    for name, axis in named_axes:
        where = "" if name == "-" else f"{name}: "
        report.notes.append(f"{where}sensor gain {axis.sensor_gain_note}.")
        report.notes.append(f"{where}{_whiteness_note(axis)}")
    report.data["axes"] = [_axis_record(axis) for axis in model.axes]
    report.data["model_notes"] = model.notes


def _background(
    axis: IdentifiedAxis,
) -> tuple[tuple[str, float | None, str, float | None, str], ...]:
    """Return each quantity, its value, how it is written, its standard error and its unit."""
    slow = axis.turbulence_fit
    return (
        ("turbulence, rms", slow.rms_nm, ".1f", slow.rms_error_nm, "nm"),
        ("turbulence, frequency", slow.frequency_hz, ".4g", slow.frequency_error_hz, "Hz"),
        ("turbulence, damping", slow.damping, ".3g", slow.damping_error, ""),
        ("turbulence, roll-off", slow.corner_hz, ".3g", slow.corner_error_hz, "Hz"),
        ("noise per frame", axis.noise_nm, ".3f", axis.noise_error_nm, "nm"),
        ("sensor gain", axis.sensor_gain, ".4f", axis.sensor_gain_error, ""),
    )


def marked_note(note: str) -> str:
    """Mark a note as such, unless it is a warning."""
    return note if note.startswith("warning") else f"note: {note}"


def _whiteness_note(axis: IdentifiedAxis) -> str:
    test = axis.whiteness
    if test.white:
        return f"innovations are white (p = {test.p_value:.2g}, {test.correlation_p_value:.2g})."
    return (
        f"innovations are not white: their cumulative power is off by up to "
        f"{100 * test.deviation:.2g} % (p = {test.p_value:.1g}, of the autocorrelation "
        f"{test.correlation_p_value:.1g}). The model leaves something out; see the figure."
    )


def _axis_record(axis: IdentifiedAxis) -> dict[str, Any]:
    turbulence, whiteness = axis.turbulence, axis.whiteness
    tests = ("deviation", "p_value", "correlation_p_value", "white")
    own = ("noise_nm", "noise_error_nm", "sensor_gain", "sensor_gain_error", "sensor_gain_note")
    return {
        "turbulence": asdict(axis.turbulence_fit)
        | {"coefficients": turbulence.coefficients, "driving_rms_nm": turbulence.driving_rms_nm},
        "vibrations": [asdict(line) for line in axis.parts],
        **{name: getattr(axis, name) for name in own},
        "whiteness": {name: getattr(whiteness, name) for name in tests},
    }
