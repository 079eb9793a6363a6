"""Where the lines of a record come from: one axis, a diagonal, or both axes without relation.

What each part of the disturbance costs a loop, in nm and in Strehl ratio.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field

import numpy as np
from scipy.signal import detrend

from lbt_synth.identification.diagnosis.running_loop import AXES
from lbt_synth.identification.fit.identified_model import DIFFERENT, IdentifiedLine, IdentifiedModel
from lbt_synth.identification.stretches import Stretches
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, jitter_strehl, model_budget
from lbt_synth.loop.budget import line_covariance
from lbt_synth.models import TipTiltPlant, Vibration
from lbt_synth.storage.rows import column, nm_column, percent_column, table_row
from lbt_synth.validation import ComplexArray, FloatArray

_SEGMENTS = 16
_LEAST_SEGMENT = 64  # frames
_LINEAR = 0.1  # of the power, that a line along a direction may have across it
_RELATED = 0.5  # coherence of axes that move together
_NEAR_AXIS_DEG = 6.0


@table_row
class LineRow:
    """A vibration, on all axes."""

    frequency_hz: float = column("f", unit="Hz", format=".3f", help="Frequency")
    frequency_error_hz: float = column("+-", unit="Hz", format=".2g", help="Its standard error")
    damping: str = column("damping", help="Damping ratio, a bound where it is not resolved")
    rms_nm: float = nm_column("rms", help="Rms over all axes")
    direction_deg: float = column(
        "direction", unit="deg", format=".1f", help="From tip (0) towards tilt (90)"
    )
    direction_error_deg: float = column("+-", unit="deg", format=".2g", help="Its error")
    origin: str = column("origin", help="Where it is from")
    vibrations: tuple[Vibration, ...] = field(default=())  # of the plant, that it is made of

    @property
    def name(self) -> str:
        """What tables of costs call it."""
        return f"line at {self.frequency_hz:.4g} Hz"

    @property
    def where(self) -> str:
        """Along what it shakes, to go on in a sentence; empty where that is not known."""
        if self.origin in AXES:
            return f" in {self.origin}"
        return "" if np.isnan(self.direction_deg) else f" along {self.direction_deg:.0f} deg"


def line_origins(
    model: IdentifiedModel, series: FloatArray, stretches: Stretches
) -> tuple[LineRow, ...]:
    """Return the lines of a model by frequency, with their origin in a series (frames, axes)."""
    found = [
        (i, part)
        for i, axis in enumerate(model.axes)
        for part in axis.parts
        if part.direction is None
    ]
    groups: list[list[tuple[int, IdentifiedLine]]] = []
    for i, part in sorted(found, key=lambda each: each[1].frequency_hz):
        if part.kind == "turbulence":
            continue
        last = groups[-1] if groups else []
        if last and all(j != i for j, _ in last) and _is_same(last[-1][1], part, model):
            last.append((i, part))
        else:
            groups.append([(i, part)])
    lines = [_describe(group, model, series, stretches) for group in groups]
    lines += [_describe_shared(line) for line in model.shared if line.kind != "turbulence"]
    return tuple(sorted(lines, key=lambda line: line.frequency_hz))


def _describe_shared(line: IdentifiedLine) -> LineRow:
    """Return a line that the model has along a direction."""
    error = np.nan if line.direction_error_deg is None else line.direction_error_deg
    angle, origin = _name_direction(line.direction_deg or 0.0, error)
    return LineRow(
        frequency_hz=line.frequency_hz,
        frequency_error_hz=line.frequency_error_hz,
        damping=_damping_text(line),
        rms_nm=line.rms_nm,
        direction_deg=angle,
        direction_error_deg=error,
        origin=_origin_text(line, origin),
        vibrations=(line.vibration(),),
    )


def _damping_text(line: IdentifiedLine) -> str:
    return f"{line.damping:.3g}" if line.resolved else f"< {line.damping:.2g}"


def _origin_text(line: IdentifiedLine, origin: str) -> str:
    return origin if line.kind == "line" else f"{origin}, broad"


def _is_same(one: IdentifiedLine, other: IdentifiedLine, model: IdentifiedModel) -> bool:
    """Whether lines of two axes are one: their frequencies agree."""
    error = float(np.hypot(one.frequency_error_hz, other.frequency_error_hz))
    width = max(one.damping * one.frequency_hz, other.damping * other.frequency_hz)
    near = max(DIFFERENT * error, min(width, model.axes[0].resolution_hz * 2))
    return abs(one.frequency_hz - other.frequency_hz) <= near


def _describe(
    group: Sequence[tuple[int, IdentifiedLine]],
    model: IdentifiedModel,
    series: FloatArray,
    stretches: Stretches,
) -> LineRow:
    """Return a line of one or two axes."""
    axes = len(model.axes)
    parts = [part for _, part in group]
    first = max(parts, key=lambda part: part.rms_nm)
    weights = np.array([1 / max(part.frequency_error_hz, 1e-12) ** 2 for part in parts])
    frequency = float(weights @ [part.frequency_hz for part in parts] / weights.sum())
    angle, error, origin = np.nan, np.nan, "one axis" if axes == 1 else ""
    if axes == 2:
        angle, error, origin = _origin(frequency, first.damping, model, series, stretches)
    each = np.eye(axes).tolist()
    return LineRow(
        frequency_hz=frequency,
        frequency_error_hz=float(1 / np.sqrt(weights.sum())),
        damping=_damping_text(first),
        rms_nm=float(np.sqrt(sum(part.rms_nm**2 for part in parts))),
        direction_deg=angle,
        direction_error_deg=error,
        origin=_origin_text(first, origin),
        vibrations=tuple(part.vibration(tuple(each[i])) for i, part in group),
    )


def _origin(
    frequency_hz: float,
    damping: float,
    model: IdentifiedModel,
    series: FloatArray,
    stretches: Stretches,
) -> tuple[float, float, str]:
    """Return direction [deg], its error, and words, from the cross-spectrum at a line."""
    power, rest, averages = _power_at(frequency_hz, damping, model.frame_rate_hz, series, stretches)
    values, vectors = np.linalg.eigh(power.real)
    if not values[1] > 0:
        return np.nan, np.nan, "not seen"
    along, beside = vectors[:, 1], vectors[:, 0]
    angle = (float(np.degrees(np.arctan2(along[1], along[0]))) + 90) % 180 - 90
    across = max(float(values[0]), 0.0) / float(values[1])
    # the rest of the spectrum across the line turns it from segment to segment
    noise = max(float(beside @ rest @ beside), 0.0) / float(values[1])
    error = float(np.degrees(np.sqrt((across + noise) / (2 * averages))))
    if across < _LINEAR:
        angle, words = _name_direction(angle, error)
        return angle, error, words
    both = float(power[0, 0].real * power[1, 1].real)
    coherence = float(abs(power[0, 1]) ** 2 / both) if both > 0 else 0.0
    if coherence > _RELATED:
        return np.nan, np.nan, "both axes, out of phase"
    return np.nan, np.nan, "both axes, unrelated"


def _name_direction(angle_deg: float, error_deg: float) -> tuple[float, str]:
    """Return a direction [deg], near tilt from 0 to 180, and what it is along."""
    near = max(_NEAR_AXIS_DEG, DIFFERENT * error_deg)
    if abs(angle_deg) < near:
        return angle_deg, AXES[0]
    if abs(angle_deg) > 90 - near:
        return angle_deg % 180, AXES[1]
    return angle_deg, "a diagonal"


def _power_at(
    frequency_hz: float, damping: float, rate_hz: float, series: FloatArray, stretches: Stretches
) -> tuple[ComplexArray, FloatArray, float]:
    """Return the cross-power (2, 2) of a line, that of its surroundings, and averages of both."""
    start, stop = max(stretches, key=lambda pair: pair[1] - pair[0])
    z = series[start:stop]
    size = 2 ** int(np.log2(max(2 * len(z) / _SEGMENTS, _LEAST_SEGMENT)))
    size = min(size, len(z))
    window = np.hanning(size)
    starts = range(0, len(z) - size + 1, max(size // 2, 1))
    parts = np.fft.rfft(
        [window[:, None] * detrend(z[a : a + size], axis=0) for a in starts], axis=1
    )
    density = np.einsum("sfi,sfj->fij", parts, parts.conj())
    f, step = np.fft.rfftfreq(size, 1 / rate_hz), rate_hz / size
    half = max(2 * step, 2 * damping * frequency_hz)
    away = np.abs(f - frequency_hz)
    near, beside = away <= half, (away > half + 2 * step) & (away <= 3 * half + 4 * step)
    level = density[beside].mean(axis=0) if beside.any() else np.zeros((2, 2))
    rest = np.count_nonzero(near) * level
    widths = 1 + np.pi * damping * frequency_hz / step  # independent values of a wide line
    return density[near].sum(axis=0) - rest, rest.real, max(len(starts) * 0.6 * widths, 1.0)


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
    losses = [_losses(table, imaging) for table in tables]
    where = {line.name: line.where for line in lines}
    rows = [
        CostRow(
            part=name,
            running_nm=_rms(tables[0], name),
            running_strehl=losses[0].get(name, np.nan),
            best_nm=_rms(tables[1], name),
            best_strehl=losses[1].get(name, np.nan),
            where=where.get(name, ""),
        )
        for name in names
    ]
    by = "running_nm" if tables[0] else "best_nm"
    return tuple(sorted(rows[:-1], key=lambda row: -getattr(row, by))) + tuple(rows[-1:])


def _covariances(
    plant: TipTiltPlant, lines: Sequence[LineRow], controller: Controller | None
) -> dict[str, FloatArray]:
    """Return the covariance (n, n) of the residual by part, and of all; none of no stable loop."""
    if controller is None:
        return {}
    loop = close_loop(plant.hardware, controller)
    if not loop.is_stable:
        return {}
    budget = model_budget(loop, plant, frame_means=True)
    out = {"turbulence": budget.turbulence_nm2, "measurement noise": budget.noise_nm2}
    for line in lines:
        parts = [line_covariance(loop, vibration) for vibration in line.vibrations]
        name = line.name if line.name not in out else f"{line.name}, another"
        out[name] = np.sum(parts, axis=0)
    rest = budget.total_nm2 - np.sum(list(out.values()), axis=0)
    out["turbulence"] = out["turbulence"] + rest  # slow resonances are turbulence
    return out | {"all": budget.total_nm2}


def _losses(parts: Mapping[str, FloatArray], imaging: Imaging) -> dict[str, float]:
    """Return the Strehl ratio that each part costs."""
    if not parts:
        return {}
    whole = parts["all"]
    strehl = jitter_strehl(whole, imaging=imaging)
    return {
        name: jitter_strehl(_without(whole, part), imaging=imaging) - strehl
        for name, part in parts.items()
    }


def _without(whole: FloatArray, part: FloatArray) -> FloatArray:
    """Return a covariance without a part of it, positive semidefinite in spite of rounding."""
    values, vectors = np.linalg.eigh(whole - part)
    return np.asarray(vectors @ np.diag(np.maximum(values, 0)) @ vectors.T)


def _rms(parts: Mapping[str, FloatArray], name: str) -> float:
    return float(np.sqrt(max(np.trace(parts[name]), 0.0))) if name in parts else np.nan
