"""Readings of accelerometers laid beside the wavefront, and fitted there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.accelerometers.band_fit import fit_band
from lbt_synth.identification.accelerometers.clock_shift import (
    ClockShift,
    Pair,
    clock_shift,
    likeliest_lag,
)
from lbt_synth.identification.accelerometers.line_bands import LineBand, line_bands
from lbt_synth.identification.fit.identified_model import IdentifiedLine, IdentifiedModel
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches
from lbt_synth.validation import BoolArray, FloatArray

_SHORTEST = 256  # frames side by side
_PASSES = 3
_NEAR_S = 1.0  # within which a shift is refined
_ROUNDS = 3  # in which the skirts of strong lines leave the bands of others


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Laid:
    """Readings beside the wavefront: by how many frames late, and fits."""

    lag: int
    fits: list[Pair]
    shift: ClockShift  # beyond the whole frames


def lay_and_fit(
    model: IdentifiedModel,
    record: LoopRecord,
    readings: FloatArray,
    good: BoolArray,
    lines: Sequence[IdentifiedLine],
    largest: int,
    limit: float,
) -> Laid:
    """Lay readings beside the wavefront, and fit them there."""
    gains, lag = np.array(model.sensor_gains), 0
    errors = np.array([axis.sensor_gain_error or 0.0 for axis in model.axes])
    series = record.pseudo_open_loop(gains)
    moved = record.pseudo_open_loop(gains + errors) - series
    near = round(_NEAR_S * model.frame_rate_hz)

    def bands(stretches: Stretches) -> list[LineBand]:
        laid = readings[np.clip(np.arange(record.frames) + lag, 0, len(readings) - 1)]
        return line_bands(model, lines, series, moved, laid, stretches)

    def side_by_side() -> Stretches:
        frames = np.arange(record.frames) + lag
        known = (frames >= 0) & (frames < len(readings))
        usable = record.usable & known & good[np.where(known, frames, 0)]
        found = tuple((int(a), int(b)) for a, b in runs(usable) if b - a >= _SHORTEST)
        if not found:
            raise ProblemError(
                f"record and accelerations must have {_SHORTEST} usable frames in a row side by "
                f"side; they have {record.frames} and {len(readings)} frames."
            )
        return found

    lag = likeliest_lag(bands(side_by_side()), largest)
    for step in range(_PASSES):
        fits = fit_pairs(bands(side_by_side()))
        shift = clock_shift([fit for fit in fits if chance(fit) < limit], near)
        sure = shift.by_phases or abs(shift.frames) > 3 * shift.error_frames
        if step == _PASSES - 1 or not sure or not round(shift.frames):
            break
        lag += round(shift.frames)
    return Laid(lag=lag, fits=fits, shift=shift)


def fit_pairs(bands: Sequence[LineBand]) -> list[Pair]:
    """Return the fit of every channel with every line."""
    out: list[Pair] = []
    for channel in range(bands[0].readings.shape[1]):
        factors = np.zeros(bands[0].expected.shape[1], dtype=complex)
        for _ in range(_ROUNDS):
            fits = [fit_band(band, channel, factors) for band in bands]
            for band, fit in zip(bands, fits, strict=True):
                factors[list(band.lines)] = fit.factors
        out += [
            (band, fit, j, channel)
            for band, fit in zip(bands, fits, strict=True)
            for j in range(len(band.lines))
        ]
    return out


def chance(pair: Pair) -> float:
    """Return the probability that a channel without the line shows as much."""
    return float(pair[1].chances[pair[2]])
