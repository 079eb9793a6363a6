"""Where the lines of a record come from: one axis, or a diagonal.

What each part of the disturbance costs a loop, in nm and in Strehl ratio.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field

import numpy as np

from lbt_synth.identification.diagnosis.running_loop import AXES
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedLine, IdentifiedModel
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, jitter_strehl, residual_budget
from lbt_synth.loop.budget import line_covariance
from lbt_synth.models import TipTiltPlant, Vibration
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.validation import FloatArray

_ALL = "all"  # parts together


@table_row
class LineRow:
    """A vibration."""

    frequency_hz: float = column("f", unit="Hz", format=".3f", help="Frequency")
    frequency_error_hz: float = column("+-", unit="Hz", format=".2g", help="Its standard error")
    damping: str = column("damping", help="Damping ratio, a bound where it is not resolved")
    rms_nm: float = nm_column("rms", help="Rms over all axes")
    direction_deg: float = column(
        "direction", unit="deg", format=".1f", help="From tip (0) towards tilt (90)"
    )
    direction_error_deg: float = column("+-", unit="deg", format=".2g", help="Its error")
    origin: str = column("origin", help="Where it is from")
    broad: bool  # too damped for a line
    vibration: Vibration  # of the plant

    @property
    def name(self) -> str:
        """What tables of costs call it."""
        return f"{'broad resonance' if self.broad else 'line'} at {self.frequency_hz:.4g} Hz"

    @property
    def where(self) -> str:
        """Along what it shakes, to go on in a sentence; empty where that is not known."""
        if self.origin in AXES:
            return f" in {self.origin}"
        return "" if np.isnan(self.direction_deg) else f" along {self.direction_deg:.0f} deg"


def line_origins(model: IdentifiedModel) -> tuple[LineRow, ...]:
    """Return the lines of a model by frequency, each with the direction in which it shakes."""
    parts = [part for part in model.parts if part.kind != "turbulence"]
    return tuple(_line_row(part, len(model.axes)) for part in sorted(parts, key=_frequency_hz))


def _frequency_hz(part: IdentifiedLine) -> float:
    return part.frequency_hz


def _line_row(part: IdentifiedLine, axes: int) -> LineRow:
    angle, error = part.direction_deg or 0.0, part.direction_error_deg
    near, origin = DIFFERENT * (error or 0.0), "a diagonal"
    if axes == 1:
        angle, origin = np.nan, "one axis"
    elif abs(angle) <= near:
        origin = AXES[0]
    elif abs(angle) >= 90 - near:
        angle, origin = angle % 180, AXES[1]
    return LineRow(
        frequency_hz=part.frequency_hz,
        frequency_error_hz=part.frequency_error_hz,
        damping=f"{part.damping:.3g}" if part.resolved else f"< {part.damping:.2g}",
        rms_nm=part.rms_nm,
        direction_deg=angle,
        direction_error_deg=np.nan if error is None else error,
        origin=origin if part.kind == "line" else f"{origin}, broad",
        broad=part.kind != "line",
        vibration=part.vibration(),
    )


@table_row
class CostRow:
    """One part of the disturbance, and what it costs two loops by the model."""

    part: str = column("part", help="Part of the disturbance")
    running_nm: float = nm_column("running", help="Residual that it leaves in the loop that ran")
    running_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")
    best_nm: float = nm_column("best design", help="Residual that it leaves in the best design")
    best_strehl: float = percent_column("Strehl lost", help="Strehl ratio that this costs")
    where: str = field(default="")  # along what a line shakes, to go on in a sentence


def disturbance_costs(
    plant: TipTiltPlant,
    lines: Sequence[LineRow],
    running: Controller | None,
    best: Controller | None,
    imaging: Imaging,
) -> tuple[CostRow, ...]:
    """Return a row per part of the disturbance, the most costly first, and one of all.

    The Strehl ratio that a part costs is that of the residual without it, less that with it: as
    residuals add up in the exponent, these do not add up to the whole loss.
    """
    tables = [_covariances(plant, lines, controller) for controller in (running, best)]
    names = next((list(table) for table in tables if table), [])
    where = {line.name: line.where for line in lines}
    rows = []
    for name in names:
        numbers = [_rms_and_strehl(table, name, imaging) for table in tables]
        (running_nm, running_strehl), (best_nm, best_strehl) = numbers
        rows.append(
            CostRow(
                part=name,
                running_nm=running_nm,
                running_strehl=running_strehl,
                best_nm=best_nm,
                best_strehl=best_strehl,
                where=where.get(name, ""),
            )
        )
    by = "running_nm" if tables[0] else "best_nm"
    rows.sort(key=lambda row: (row.part == _ALL, -getattr(row, by)))
    return tuple(rows)


def _covariances(
    plant: TipTiltPlant, lines: Sequence[LineRow], controller: Controller | None
) -> dict[str, FloatArray]:
    """Return the covariance (n, n) of the residual by part, and of all; none of no stable loop."""
    if controller is None:
        return {}
    loop = close_loop(plant.hardware, controller)
    if not loop.is_stable:
        return {}
    budget = residual_budget(loop, plant, frame_means=True)
    out = {"turbulence": budget.turbulence_nm2, "measurement noise": budget.noise_nm2}
    for line in lines:  # two of one frequency are one part
        out[line.name] = out.get(line.name, 0.0) + line_covariance(loop, line.vibration)
    rest = budget.total_nm2 - np.sum(list(out.values()), axis=0)
    out["turbulence"] = out["turbulence"] + rest  # slow resonances are turbulence
    return out | {_ALL: budget.total_nm2}


def _rms_and_strehl(
    parts: Mapping[str, FloatArray], name: str, imaging: Imaging
) -> tuple[float, float]:
    """Return the rms that a part leaves, and the Strehl ratio that it costs."""
    if name not in parts:
        return np.nan, np.nan
    others = [parts[part] for part in parts if part not in (name, _ALL)]
    rest = np.sum(others, axis=0) if name != _ALL else 0 * parts[_ALL]
    strehl = jitter_strehl(parts[_ALL], imaging=imaging)
    rms_nm = float(np.sqrt(max(np.trace(parts[name]), 0.0)))
    return rms_nm, jitter_strehl(rest, imaging=imaging) - strehl
