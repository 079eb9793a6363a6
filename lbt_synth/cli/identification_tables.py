"""What identify and auto print of a record and of the model identified from it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from lbt_synth.cli.output import Report, TableText, format_fixed, tabulate
from lbt_synth.identification import (
    IdentifiedAxis,
    IdentifiedLine,
    IdentifiedModel,
    LoopRecord,
    SpectrumRecord,
)
from lbt_synth.identification.records.health import HEADINGS


def add_record(report: Report, record: LoopRecord | SpectrumRecord) -> None:
    """Add what a record holds, and what was found wrong with it."""
    if isinstance(record, SpectrumRecord):
        _add_spectra(report, record)
    else:
        _add_series(report, record)


def _add_spectra(report: Report, record: SpectrumRecord) -> None:
    f = record.frequency_hz
    report.data["record"] = {"kind": "spectrum", "frequencies": f.size, "notes": record.notes}
    report.tables.append(
        TableText(
            title=f"Spectra of {_axes_text(record.axes)}",
            headings=("axis", "from [Hz]", "to [Hz]", "rms [nm]"),
            rows=[
                (name, float(f[0]), float(f[-1]), format_fixed(float(rms), 1))
                for name, rms in zip(_axis_names(record.axes), record.rms_nm, strict=True)
            ],
        )
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
        title = f"Record: {text}: {health.summary()}"
        report.tables.append(TableText(title=title, headings=HEADINGS, rows=rows))
    else:
        report.notes.append(f"record: {text}; {health.summary()}")
    report.notes += [f"note: {note}" for note in health.notes]


def _axes_text(count: int) -> str:
    return "1 axis" if count == 1 else f"{count} axes"


def _axis_names(count: int) -> list[str]:
    return ["tip", "tilt"] if count == 2 else ["-"] * count


def add_model(report: Report, model: IdentifiedModel) -> None:
    """Add the tables of an identified model, its notes, and its numbers."""
    names = _axis_names(len(model.axes))
    named_axes = list(zip(names, model.axes, strict=True))
    report.tables.append(
        TableText(
            title="Turbulence, noise and sensor",
            headings=("quantity", "axis", "value", "error", "unit"),
            rows=[row for name, axis in named_axes for row in _background_rows(name, axis)],
        )
    )
    lines = [(name, line) for name, axis in named_axes for line in axis.parts]
    if lines:
        report.tables.append(
            tabulate(
                "Vibrations",
                lines,
                ("axis", lambda item: item[0]),
                ("f [Hz]", lambda item: format_fixed(item[1].frequency_hz, 3)),
                ("+-", lambda item: f"{item[1].frequency_error_hz:.2g}"),
                ("damping", lambda item: _damping_texts(item[1])[0]),
                ("+-", lambda item: _damping_texts(item[1])[1]),
                ("rms [nm]", lambda item: format_fixed(item[1].rms_nm, 2)),
                ("+-", lambda item: f"{item[1].rms_error_nm:.2g}"),
                ("over the rest", lambda item: f"{item[1].prominence:.3g}"),
                ("origin", lambda item: item[1].kind + ", announced" * item[1].announced),
            )
        )
    else:
        report.notes.append("no vibration stands out of the turbulence and the noise.")
    report.notes += [marked_note(note) for note in model.notes]
    for name, axis in named_axes:
        where = "" if name == "-" else f"{name}: "
        report.notes.append(f"{where}sensor gain {axis.sensor_gain_note}.")
        report.notes.append(f"{where}{_whiteness_note(axis)}")
    report.data["axes"] = [_axis_record(axis) for axis in model.axes]
    report.data["model_notes"] = model.notes


def _damping_texts(line: IdentifiedLine) -> tuple[str, str | None]:
    if line.resolved:
        return f"{line.damping:.3g}", f"{line.damping_error:.2g}"
    return f"< {line.damping:.2g}", None


def marked_note(note: str) -> str:
    """Mark a note as such, unless it is a warning."""
    return note if note.startswith("warning") else f"note: {note}"


def _background_rows(name: str, axis: IdentifiedAxis) -> list[tuple[Any, ...]]:
    slow, error = axis.turbulence_fit, axis.sensor_gain_error
    rows: list[tuple[Any, ...]] = [
        ("turbulence, rms", name, format_fixed(slow.rms_nm, 1), f"{slow.rms_error_nm:.2g}", "nm"),
        (
            "turbulence, frequency",
            name,
            f"{slow.frequency_hz:.4g}",
            f"{slow.frequency_error_hz:.2g}",
            "Hz",
        ),
        ("turbulence, damping", name, f"{slow.damping:.3g}", f"{slow.damping_error:.2g}", ""),
    ]
    if slow.corner_hz is not None and slow.corner_error_hz is not None:
        rows.append(
            (
                "turbulence, roll-off",
                name,
                f"{slow.corner_hz:.3g}",
                f"{slow.corner_error_hz:.2g}",
                "Hz",
            )
        )
    rows += [
        (
            "noise per frame",
            name,
            format_fixed(axis.noise_nm, 3),
            f"{axis.noise_error_nm:.2g}",
            "nm",
        ),
        (
            "sensor gain",
            name,
            format_fixed(axis.sensor_gain, 4),
            None if error is None else f"{error:.2g}",
            "",
        ),
    ]
    return rows


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
    return {
        "turbulence": asdict(axis.turbulence_fit)
        | {
            "coefficients": axis.turbulence.coefficients,
            "driving_rms_nm": axis.turbulence.driving_rms_nm,
        },
        "vibrations": [asdict(line) for line in axis.parts],
        "noise_nm": axis.noise_nm,
        "noise_error_nm": axis.noise_error_nm,
        "sensor_gain": axis.sensor_gain,
        "sensor_gain_error": axis.sensor_gain_error,
        "sensor_gain_note": axis.sensor_gain_note,
        "whiteness": {
            "deviation": axis.whiteness.deviation,
            "p_value": axis.whiteness.p_value,
            "correlation_p_value": axis.whiteness.correlation_p_value,
            "white": axis.whiteness.white,
        },
    }
