"""The tables of an identified model, as ``lbt-synth identify`` and ``print`` show them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.storage.display_unit import shown_format, shown_unit
from lbt_synth.storage.rows import cell_text, column, fill_row, nm_column, row_table, table_row
from lbt_synth.storage.tables import Table

if TYPE_CHECKING:
    from lbt_synth.identification.fit.identified_model import (
        IdentifiedAxis,
        IdentifiedLine,
        IdentifiedModel,
    )


@table_row
class VibrationRow:
    """A vibration on one axis, or along a direction over both."""

    axis: str = column("axis")  # or the direction
    frequency_hz: float = column("f", unit="Hz", format=".3f")
    frequency_error_hz: float = column("+-", unit="Hz", format=".2g")
    frequency_error_if_several_hz: float | None = column("if several", unit="Hz", format=".2g")
    damping: str = column("damping")  # one that is not resolved has a bound, and no error
    damping_error: float | None = column("+-", format=".2g")
    rms_nm: float = nm_column("rms", format=".2f")
    rms_error_nm: float = column("+-", unit="nm", format=".2g")
    prominence: float = column("over the rest", format=".3g")
    origin: str = column("origin")


def axis_names(count: int) -> list[str]:
    """Return what tables call each axis."""
    return ["tip", "tilt"] if count == 2 else ["-"] * count


def model_tables(model: IdentifiedModel) -> list[Table]:
    """Return turbulence, noise and sensor of each axis, and the vibrations if there are any."""
    names = axis_names(len(model.axes))
    background = Table(
        caption="Turbulence, noise and sensor",
        headings=("quantity", "axis", "value", "error", "unit"),
        rows=tuple(
            (quantity, name, *_shown_cells(value, digits, error, unit))
            for name, axis in zip(names, model.axes, strict=True)
            for quantity, value, digits, error, unit in _background(axis)
            if value is not None
        ),
        words=(4,),
    )
    lines = [
        fill_row(
            VibrationRow,
            line,
            axis=_direction_text(line, names),
            damping=f"{line.damping:.3g}" if line.resolved else f"< {line.damping:.2g}",
            damping_error=line.damping_error if line.resolved else None,
            origin=line.kind + ", announced" * line.announced,
        )
        for line in model.parts
    ]
    return [background, *([row_table("Vibrations", lines)] if lines else [])]


def _shown_cells(value: float, digits: str, error: float | None, unit: str) -> tuple[str, str, str]:
    """Return the cells of a value, its error and its unit."""
    name, factor = shown_unit(unit)
    size = None if error is None else factor * error
    return cell_text(factor * value, shown_format(digits, factor)), cell_text(size, ".2g"), name


def _direction_text(line: IdentifiedLine, names: Sequence[str]) -> str:
    """Return the axis of a line, or the direction of one that both axes share."""
    assert line.direction is not None  # of the parts of a model
    if np.count_nonzero(line.direction) == 1:
        return names[int(np.argmax(line.direction))]
    error = line.direction_error_deg
    return f"{line.direction_deg:.4g}{'' if error is None else f' +- {error:.1g}'} deg"


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
        (
            "noise, correlation",
            axis.noise_correlation or None,
            ".3f",
            axis.noise_correlation_error,
            "",
        ),
        ("sensor gain", axis.sensor_gain, ".4f", axis.sensor_gain_error, ""),
    )
