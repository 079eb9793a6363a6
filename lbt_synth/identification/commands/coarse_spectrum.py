"""The likelihood of repaired commands, by a coarse spectrum of the pseudo-open loop.

The measurement is ``y = z - g c``, with z what an open loop would have measured and c the
correction. Each repair gives another c and z, and z has a simple spectrum only if c is
right: white noise, turbulence that falls, a few resonances, lines with their skirts. The
likelihood is Whittle's, as in the fit of the model; its Jacobian is 1 because c follows from the
past of y.

Frequencies are merged into bands, except around peaks. There each frequency has a power of its
own: a band without a model still counts, because a wrong filter that makes one band smaller makes
another larger (Jensen's formula).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    LoopPeriodogram,
    half_angle_square,
    segment_transforms,
)
from lbt_synth.identification.records.faults import runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

MOST_SHIFT_FRAMES = 3  # by which commands are tried earlier and later
SEGMENT_S = 6.0  # resolves lines 0.3 Hz apart, and leaves several segments of half a minute
CLEAR = 20.0  # nats that decide
_SHORTEST_SEGMENT = 2 * SHORTEST_SEGMENT  # frames, where the record has them
_MOST_SEGMENTS = 24  # more make the answer slower and not another one
_NATURAL_GAINS = np.array([0.1, 0.3, 1.0])  # starts, of the gain that makes powers equal
_BAND = 0.06  # of its frequency: width of a band, in which turbulence is a straight line
_SHAPES_HZ = np.geomspace(1.5, 25.0, 8)  # of wide resonances, each as wide as their distance
_SHAPE_DAMPING = 0.5 * float(np.log(_SHAPES_HZ[1] / _SHAPES_HZ[0]))
_FASTEST_HZ = 6.0  # corner of the turbulence of an 8 m telescope
_LINE_DAMPING = 0.004  # of the skirts of a line, which do not show it
_SMALLEST = float(np.finfo(np.float32).eps)  # of the measured power: rounding without noise
_PASSES = 400  # of the fit, after which no contrast moves by a tenth of what decides
_LARGEST_STEP = 1.2  # factor on a gain
_PEAK, _SKIRT = 3.0, 1.25  # factors of a peak, and of its skirt, over the surroundings
_REACH = 40  # frequencies on either side of a peak, which are its surroundings

CoarseFit: TypeAlias = tuple[FloatArray, FloatArray]  # minus log-likelihoods, and best gains
CoarseAxis: TypeAlias = tuple[LoopPeriodogram, LoopPeriodogram, FloatArray]


def coarse_stretches(record: LoopRecord) -> list[tuple[int, int]]:
    """Return the stretches (start, stop) that are long enough, and that no shift leaves."""
    most = MOST_SHIFT_FRAMES
    trimmed = [(start + most, stop - most) for start, stop in record.stretches()]
    return [(start, stop) for start, stop in trimmed if stop - start >= _SHORTEST_SEGMENT]


def repaired_corrections(record: LoopRecord, repair: CommandRepair) -> FloatArray:
    """Return the corrections of repaired commands, but for their matrix, (frames, axes) [nm]."""
    corrections = record.corrections()
    if repair.increments:  # sums of commands give sums of corrections
        corrections = np.cumsum(corrections, axis=0)
    return np.roll(corrections, repair.shift_frames, axis=0)


def compare_repairs(record: LoopRecord, repairs: Sequence[CommandRepair]) -> CoarseFit:
    """Return minus log-likelihoods and gains of n repairs and of none at all, (axes, n + 1)."""
    rate = record.frame_rate_hz
    rows = _segments(coarse_stretches(record), rate)
    frequency_hz, measured, independent = segment_transforms(
        record.measurements, rows, rate, levelled=True
    )
    plain, turned = dict[tuple[bool, int], ComplexArray](), list[ComplexArray]()
    for repair in repairs:
        if (key := (repair.increments, repair.shift_frames)) not in plain:
            series = repaired_corrections(record, repair)
            plain[key] = segment_transforms(series, rows, rate, levelled=True)[1]
        turned.append(np.tensordot(repair.turn(record.axes), plain[key], 1))
    corrections = np.array([*turned, 0 * turned[0]])
    high, fits = frequency_hz > 0.05 * rate, list[CoarseFit]()
    for i in range(record.axes):
        level = np.mean(abs(measured[i][:, high]) ** 2)
        steps = np.mean(abs(corrections[:, i][..., high]) ** 2, axis=(1, 2))
        rounding = np.finfo(float).eps ** 2 * level  # clipped commands may hardly move
        natural = np.sqrt(level / np.maximum(steps, max(rounding, np.finfo(float).tiny)))
        data = coarse_axis(
            frequency_hz,
            measured[i],
            corrections[:, i],
            independent=independent,
            frame_rate_hz=rate,
        )
        fits.append(fit_guesses(data, natural[:, None] * _NATURAL_GAINS))
    contrast, gain = (np.array(values) for values in zip(*fits, strict=True))
    return contrast, gain


def _segments(stretches: Sequence[tuple[int, int]], frame_rate_hz: float) -> IntArray:
    """Return the frames of segments of some seconds, (segments, length), evenly spread."""
    longest = max(stop - start for start, stop in stretches)
    usual = max(SEGMENT_S * frame_rate_hz, _SHORTEST_SEGMENT)
    length = int(min(usual, max(longest // 2, _SHORTEST_SEGMENT), longest))
    starts = [k for start, stop in stretches for k in range(start, stop - length + 1, length)]
    chosen = np.unique(np.linspace(0, len(starts) - 1, _MOST_SEGMENTS).astype(np.intp))
    return np.array(starts)[chosen][:, None] + np.arange(length)


def find_spectral_peaks(
    frequency_hz: FloatArray, power: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the frequencies at peaks (f,), where the peaks are and their widths [Hz], (l,)."""
    from scipy.ndimage import binary_dilation, binary_propagation, median_filter

    log = np.log(np.convolve(np.pad(power, 1, mode="edge"), np.full(3, 1 / 3), mode="valid"))
    above = log - median_filter(log, size=2 * _REACH + 1, mode="nearest")
    regions = binary_propagation(above > np.log(_PEAK), mask=above > np.log(_SKIRT))
    is_peak = np.asarray(binary_dilation(regions, iterations=2))
    edges = runs(is_peak)
    tops = np.array([a + np.argmax(power[a:b]) for a, b in edges], dtype=np.intp)
    width = np.maximum(2.0, 0.3 * (edges[:, 1] - edges[:, 0]))
    return is_peak, frequency_hz[tops], width * (frequency_hz[1] - frequency_hz[0])


def _shapes(square: FloatArray, lowest_hz: float, skirts: FloatArray) -> FloatArray:
    """Return the shapes of noise, turbulence, wide resonances and skirts over the bands, (k, b)."""
    # nothing but noise and skirts has a place at high frequencies, where wrong corrections show
    corners = np.geomspace(lowest_hz, _FASTEST_HZ, 5)
    falls = [(1 + square / corner**2) ** -order for corner in corners for order in (1, 2, 3)]
    wide = _resonance(square, _SHAPES_HZ, _SHAPE_DAMPING)
    shapes = np.array([np.ones_like(square), *falls, *wide, *skirts])
    return np.asarray(shapes / np.max(shapes, axis=1, keepdims=True))


def _resonance(square: FloatArray, centre_hz: FloatArray, damping: float) -> FloatArray:
    """Return the spectra of second-order processes, (k, b), 1 at low frequencies."""
    centre = centre_hz[:, None] ** 2
    return np.asarray(centre**2 / ((square - centre) ** 2 + 4 * damping**2 * centre * square))


def coarse_axis(
    frequency_hz: FloatArray,
    measured: ComplexArray,
    guesses: ComplexArray,
    *,
    independent: float,
    frame_rate_hz: float,
) -> CoarseAxis:
    """Return an axis in bands, at peaks, and shapes (k, bands), with n guesses (n, segments, f)."""
    power = np.mean(abs(measured) ** 2, axis=0)
    is_peak, lines, width = find_spectral_peaks(frequency_hz, power)
    every = LoopPeriodogram(
        frequency_hz=frequency_hz,
        measured=power,
        crossed=np.mean((measured.conj() * guesses).real, axis=1),
        corrected=np.mean(guesses.real**2 + guesses.imag**2, axis=1),
        count=np.full(power.size, independent),
        frame_rate_hz=frame_rate_hz,
    )
    bands = every.take(~is_peak)
    bands = bands.merge(_BAND * bands.frequency_hz)

    def warp(f: FloatArray) -> FloatArray:  # as that of a sampled process [Hz^2]
        return half_angle_square(f, frame_rate_hz) * (frame_rate_hz / (2 * np.pi)) ** 2

    # only the skirts of a line are compared, which do not show its damping; a line on either side
    # of its peak stands for one between them
    places = np.concatenate([lines - width, lines + width])
    square, centres = warp(bands.frequency_hz), np.sqrt(warp(places[places > 0]))
    skirts = _resonance(square, centres, _LINE_DAMPING)
    return bands, every.take(is_peak), _shapes(square, frequency_hz[0], skirts)


def fit_guesses(axis: CoarseAxis, starts: FloatArray) -> CoarseFit:
    """Fit spectrum and gain of each guess, from each of its starting gains (n, s).

    The amplitudes of the shapes follow multiplicative updates (C. Fevotte, N. Bertin, J.-L.
    Durrieu, Neural Comput. 21, 793 (2009), doi:10.1162/neco.2008.04-08-771, algorithm 1), the gain
    follows Newton's steps with the expected curvature.
    """
    guesses, many = starts.shape
    gain, guess = starts.ravel(), np.repeat(np.arange(guesses), many)
    bands, peaks, shapes = axis[0].row(guess), axis[1].row(guess), axis[2]
    count, at_peaks = bands.count, peaks.count
    level = np.median(_power(bands, gain), axis=1)[:, None]
    a = level / (len(shapes) * np.mean(shapes, axis=1))
    model = a @ shapes
    for _ in range(_PASSES):
        weight = count / model
        a = a * ((weight * _power(bands, gain) / model) @ shapes.T) / (weight @ shapes.T)
        a = np.maximum(a, 1e-12 * np.max(a, axis=1, keepdims=True))
        model = a @ shapes
        slope = _slope(bands, gain) / model
        steep = _slope(peaks, gain) / _power(peaks, gain)
        gradient = slope @ count + steep @ at_peaks
        curvature = (bands.corrected / model) @ (2 * count) + steep**2 @ at_peaks
        step = gradient / np.maximum(curvature, np.finfo(np.float64).tiny)
        gain = np.clip(gain - step, gain / _LARGEST_STEP, gain * _LARGEST_STEP)
    ratio = _power(bands, gain) / model
    contrast = (np.log(model) + ratio) @ count
    contrast += (np.log(_power(peaks, gain)) + 1) @ at_peaks
    best = np.argmin(contrast.reshape(starts.shape), axis=1) + many * np.arange(guesses)
    return contrast[best], gain[best]


def _power(data: LoopPeriodogram, gain: FloatArray) -> FloatArray:
    """Return the power of each row at its gain, (rows, f), above rounding."""
    return np.asarray(np.maximum(data.power(gain[:, None]), _SMALLEST * data.measured))


def _slope(data: LoopPeriodogram, gain: FloatArray) -> FloatArray:
    """Return the derivative of the power of each row by its gain, (rows, f)."""
    return 2 * (data.crossed + gain[:, None] * data.corrected)
