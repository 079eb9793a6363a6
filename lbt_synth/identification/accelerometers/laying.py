"""Readings of accelerometers laid beside the wavefront, and fitted there.

Readings may lag behind the wavefront by some frames. A shift turns the phase of every frequency in
proportion. Within a narrow line that slope is hard to see. Over several lines it is seen well if
the channels move with or against the wavefront, phases 0 or 180 degrees, as parts of a stiff
structure do. That is tested, not assumed: where the phases differ, or another shift explains them
as well, only the slope within the lines counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.accelerometers.line_bands import (
    BandFit,
    LineBand,
    fit_band,
    line_bands,
)
from lbt_synth.identification.fit.identified_model import IdentifiedLine, IdentifiedModel
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray

_PASSES = 3
_NEAR_S = 1.0  # within which a shift is refined
_ROUNDS = 3  # in which the skirts of strong lines leave the bands of others
_STEP = 0.5  # frames
_FINE = 0.01
_RIVAL = 6.9  # of the logarithm of the likelihood: 1000 times less likely
_CHANCE = 1e-3  # of phases as far from 0 and 180 degrees
_TURN = 0.3  # rad, of the edges of a band from one lag that is tried to the next
_CLEARLY = 10.0  # by which a shift must be likelier than none before readings are moved by it

Pair = tuple[LineBand, BandFit, int, int]  # band, fit of the channel, line of the band, channel


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockShift:
    """By how many frames readings lag behind the wavefront's measurement of the same frame."""

    frames: float  # shift [frames], above 0 for readings that come late
    error_frames: float  # standard error [frames]; infinite without any line
    # whether phases of several lines give it, or the slope of the phase within lines
    by_phases: bool


def lay_and_fit(
    model: IdentifiedModel,
    record: LoopRecord,
    readings: FloatArray,
    good: BoolArray,
    lines: Sequence[IdentifiedLine],
    largest: int,
    limit: float,
) -> tuple[int, list[Pair], ClockShift]:
    """Lay readings beside the wavefront, and fit them there.

    Return by how many frames they are late, the fits, and the shift beyond the whole frames.
    """
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
        found = tuple((int(a), int(b)) for a, b in runs(usable) if b - a >= SHORTEST_SEGMENT)
        if not found:
            raise ProblemError(
                f"record and accelerations must have {SHORTEST_SEGMENT} usable frames in a row "
                f"side by side; they have {record.frames} and {len(readings)} frames."
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
    return lag, fits, shift


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


def likeliest_lag(bands: Sequence[LineBand], largest: int) -> int:
    """Return the whole number of frames at which readings and wavefront agree best."""
    lags = np.arange(-largest, largest + 1.0)
    total = np.zeros(lags.size)
    for band in bands:
        middle = float(np.mean(band.angle[[0, -1]]))
        away = band.angle - middle  # a product changes over lags as slowly as the band is narrow
        step = max(int(_TURN / float(np.max(np.abs(away), initial=_TURN / lags.size))), 1)
        tried = np.append(np.arange(-largest, largest, step), largest).astype(float)
        turns = np.exp(1j * tried[:, None] * away)
        for line in band.lines:
            products = band.expected[:, line, None].conj() * band.readings
            power = np.sum(np.abs(products) ** 2, axis=0)
            seen = power > 0
            sizes = np.sum(np.abs(turns @ products[:, seen]) ** 2 / power[seen], axis=1)
            total += np.interp(lags, tried, sizes)
    best = int(np.argmax(total))
    return int(lags[best]) if total[best] > total[largest] + _CLEARLY else 0


def clock_shift(pairs: Sequence[Pair], largest: float) -> ClockShift:
    """Return the shift of the readings of the pairs of channel and line, within +- ``largest``."""
    from scipy.special import chdtrc

    if not pairs:
        return ClockShift(frames=0.0, error_frames=float("inf"), by_phases=False)
    lags = np.arange(-largest, largest + _STEP / 2, _STEP)
    free, real = _evidence(pairs, lags)
    place, error = _peak(pairs, float(lags[np.argmax(real)]), 1)
    both = _evidence(pairs, np.array([place]))
    peaks = np.flatnonzero((real[1:-1] > real[:-2]) & (real[1:-1] > real[2:])) + 1
    rivals = (np.abs(lags[peaks] - place) > 2 * _STEP) & (real[peaks] > both[1][0] - _RIVAL)
    misfit, others = 2 * float(both[0][0] - both[1][0]), len(pairs) - 1
    if others and not rivals.any() and chdtrc(others, misfit) > _CHANCE:
        spread = np.sqrt(max(misfit / others, 1.0))
        error = float(np.hypot(error * spread, _gain_error(pairs)))
        return ClockShift(frames=place, error_frames=error, by_phases=True)
    place, error = _peak(pairs, float(lags[np.argmax(free)]), 0)
    return ClockShift(frames=place, error_frames=error, by_phases=False)


def _gain_error(pairs: Sequence[Pair]) -> float:
    """Return what errors of the sensor gains leave of the shift by phases [frames].

    They turn the factors of all lines and channels at once.
    """
    slope, size = 0.0, 0.0
    for band, fit, j, _ in pairs:
        turn = (fit.slopes[j] / fit.factors[j]).imag  # [rad] per standard error of each gain
        angle = float(np.mean(band.angle[band.core[:, j]]))
        weight = 2 * abs(fit.factors[j]) ** 2 / fit.variances[j]
        slope, size = slope + weight * angle * turn, size + weight * angle**2
    return float(np.linalg.norm(slope / size))


def _evidence(pairs: Sequence[Pair], lags: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return log-likelihoods over lags, for factors of any phase and for real ones."""
    free, real = np.zeros(lags.size), np.zeros(lags.size)
    for band, fit, j, _ in pairs:
        sums, size = _matched(band, fit, j, lags)
        free += np.abs(sums) ** 2 / size
        real += sums.real**2 / size
    return free, real


def _matched(band: LineBand, fit: BandFit, j: int, lags: FloatArray) -> tuple[ComplexArray, float]:
    """Return products of readings and expectation over lags, and the size of the latter.

    The other lines of the band are taken away.
    """
    core, x = band.core[:, j], band.expected[:, list(band.lines)]
    alone = fit.readings - x @ fit.factors + x[:, j] * fit.factors[j]
    seen = (x[:, j].conj() * fit.weights)[core]
    turns = np.exp(1j * lags[:, None] * band.angle[core])
    scale = abs(fit.factors[j]) ** 2 / max(fit.variances[j], np.finfo(float).tiny)
    size = float((np.abs(x[core, j]) ** 2 * fit.weights[core]).sum())
    # in units in which the log-likelihood of the fit itself is that of its errors
    size *= max(abs(fit.factors[j]) ** 2 * size / scale, 1.0)
    return turns @ (seen * alone[core]), size


def _peak(pairs: Sequence[Pair], near: float, which: int) -> tuple[float, float]:
    """Return the place of a maximum near a lag and its standard error [frames]."""
    for step in (_STEP / 5, _FINE):
        lags = np.arange(-10.0, 11.0) * step + near
        near = float(lags[np.argmax(_evidence(pairs, lags)[which])])
    width = 0.05
    for _ in range(12):  # a step over which the likelihood changes by about 1
        low, top, high = _evidence(pairs, np.array([near - width, near, near + width]))[which]
        curvature = (2 * top - low - high) / width**2
        if 2 * top - low - high > 1 or curvature <= 0:
            break
        width *= 2
    if curvature <= 0:
        return near, float("inf")
    place = near + width * (high - low) / (2 * (2 * top - low - high))
    return place, float(1 / np.sqrt(curvature))
