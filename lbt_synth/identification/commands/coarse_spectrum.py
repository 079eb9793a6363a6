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
from lbt_synth.identification.fit.scoring import MOST_STEPS
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

MOST_SHIFT_FRAMES = 3  # by which commands are tried earlier and later
_NATURAL_GAINS = np.array([0.08, 0.28, 0.8])  # starts, of the gain that makes powers equal
_ENOUGH = 1.5  # mean deviance of a band that the coarse spectrum describes
SEGMENT_S = 6.0  # resolves lines 0.3 Hz apart, and leaves several segments of half a minute
CLEAR = 20.0  # nats that decide
_SHORTEST_SEGMENT = 2 * SHORTEST_SEGMENT  # frames, where the record has them
_MOST_SEGMENTS = 24  # more make the answer slower and not another one
_BAND = 0.06  # of its frequency: width of a band, in which turbulence is a straight line
_FASTEST_HZ = 6.0  # corner of the turbulence of an 8 m telescope
_CORNERS, _ORDERS = 5, (1, 2, 3)  # slopes of -2, -4, -6
_BUMPS_HZ, _BUMPS, _BUMP_DAMPING = (1.5, 25.0), 8, 0.18
_LINE_DAMPING = 0.004  # of the skirts of a line, which do not show it
_SMALLEST = 1e-9  # of the measured power: what a noise-free record leaves of rounding
_FIRST_PASSES = 20  # multiplicative updates of the amplitudes before the scoring
_SETTLED = 0.003  # nats that a step still gains
_LARGEST = 2.0  # step of the logarithm of an amplitude
_PEAK, _SKIRT = 3.0, 1.25  # factors of a peak, and of its skirt, over the surroundings
_REACH = 40  # frequencies on either side of a peak, which are its surroundings
_MOST_PEAKS = 16  # each adds two shapes to the fit

# minus the logarithm of the likelihood of each repair, its best gain, and its misfit: the mean
# deviance of a band, about 1 if the shapes suffice
CoarseFit: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


class CoarseRecord:
    """The transforms of one record, on which repairs are compared; none without ``stretches``.

    ``resonances`` are known ones that the spectra of the axes may show, by frequency [Hz] and
    damping ratio.
    """

    def __init__(
        self,
        record: LoopRecord,
        resonances: Sequence[Sequence[tuple[float, float]]] | None = None,
    ) -> None:
        self.record = record
        open_loop = np.zeros(record.measurements.shape)
        self.commands: FloatArray = open_loop if record.commands is None else record.commands
        self.resonances = [()] * record.axes if resonances is None else resonances
        most = MOST_SHIFT_FRAMES  # no shift leaves the stretch
        trimmed = [(a + most, b - most) for a, b in record.stretches()]
        self.stretches = [(a, b) for a, b in trimmed if b - a >= _SHORTEST_SEGMENT]
        self._known: dict[tuple[bool, int], ComplexArray] = {}
        if self.stretches:
            self.rows = _segments(self.stretches, record.frame_rate_hz)
            every = self._transform(record.measurements)
            self.frequency_hz, self.measured, self.independent = every

    def _transform(self, series: FloatArray) -> tuple[FloatArray, ComplexArray, float]:
        return segment_transforms(series, self.rows, self.record.frame_rate_hz, levelled=True)

    def _unturned(self, repair: CommandRepair) -> FloatArray:
        """Return the corrections of repaired commands, but for the matrix, (frames, axes) [nm]."""
        u = np.cumsum(self.commands, axis=0) if repair.increments else self.commands
        corrections = past_corrections(self.record.mirror_taps, u)
        return np.roll(corrections, repair.shift_frames, axis=0)

    def transform(self, repair: CommandRepair) -> ComplexArray:
        """Return the transforms of the corrections of repaired commands, (axes, segments, f)."""
        key = (repair.increments, repair.shift_frames)
        if key not in self._known:
            self._known[key] = self._transform(self._unturned(repair))[1]
        return np.tensordot(repair.turn(self.record.axes), self._known[key], 1)

    def corrections(self, repair: CommandRepair) -> FloatArray:
        """Return the corrections of repaired commands as series, (frames, axes) [nm]."""
        return self._unturned(repair) @ repair.turn(self.record.axes).T

    def compare(self, repairs: Sequence[CommandRepair]) -> CoarseFit:
        """Return contrast and best gain of each repair, (axes, n) each, and its misfit, (n,)."""
        corrections = np.array([self.transform(repair) for repair in repairs])
        fits = [self._fit_axis(i, corrections[:, i]) for i in range(self.record.axes)]
        contrast, gain, misfit = (np.array(values) for values in zip(*fits, strict=True))
        return contrast, gain, np.mean(misfit, axis=0)

    def profile(self, repair: CommandRepair, gains: FloatArray) -> FloatArray:
        """Return the contrasts (axes, n) at gains (axes, n)."""
        pairs = enumerate(zip(self.transform(repair), gains, strict=True))
        return np.array([self._axis(i, c[None]).fit_profile(g)[0] for i, (c, g) in pairs])

    def unrelated(self) -> FloatArray:
        """Return the contrast of each axis if commands do not reach the measurements, (axes,)."""
        return self.profile(CommandRepair(), np.zeros((self.record.axes, 1)))[:, 0]

    def _axis(self, i: int, corrections: ComplexArray) -> CoarseAxis:
        """Return the bands of one axis, for all repairs of its corrections."""
        return CoarseAxis(
            self.frequency_hz,
            self.measured[i],
            corrections,
            independent=self.independent,
            frame_rate_hz=self.record.frame_rate_hz,
            resonances=self.resonances[i],
        )

    def _fit_axis(self, i: int, corrections: ComplexArray) -> CoarseFit:
        """Fit all repairs of one axis, from multiples of the gain that is natural for each."""
        high = self.frequency_hz > 0.05 * self.record.frame_rate_hz
        level = np.mean(abs(self.measured[i][:, high]) ** 2)
        steps = np.mean(abs(corrections[..., high]) ** 2, axis=(1, 2))
        rounding = np.finfo(float).eps ** 2 * level  # clipped commands may hardly move
        natural = np.sqrt(level / np.maximum(steps, max(rounding, np.finfo(float).tiny)))
        return self._axis(i, corrections).fit_guesses(natural[:, None] * _NATURAL_GAINS)


def dispersion(misfit: float) -> float:
    """Return the factor by which a misfit raises what decides, at least 1."""
    return max(1.0, misfit / _ENOUGH)


def _segments(stretches: Sequence[tuple[int, int]], frame_rate_hz: float) -> IntArray:
    """Return the frames of segments of some seconds, (segments, length), evenly spread."""
    longest = max(stop - start for start, stop in stretches)
    usual = max(SEGMENT_S * frame_rate_hz, _SHORTEST_SEGMENT)
    length = int(min(usual, max(longest // 2, _SHORTEST_SEGMENT), longest))
    starts = [
        start + i * length for start, stop in stretches for i in range((stop - start) // length)
    ]
    chosen = np.unique(np.linspace(0, len(starts) - 1, _MOST_SEGMENTS).astype(np.intp))
    return np.array(starts)[chosen][:, None] + np.arange(length)


def find_spectral_peaks(
    frequency_hz: FloatArray, power: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the frequencies at peaks (f,), where the peaks are and their widths [Hz], (l,)."""
    from scipy.ndimage import binary_dilation, label, maximum, median_filter

    log = np.log(np.convolve(np.pad(power, 1, mode="edge"), np.full(3, 1 / 3), mode="valid"))
    above = log - median_filter(log, size=2 * _REACH + 1, mode="nearest")
    region, count = label(above > np.log(_SKIRT))
    height = np.array(maximum(above, region, np.arange(1, count + 1)), dtype=np.float64)
    strongest = np.argsort(-height, kind="stable")[:_MOST_PEAKS]
    peaks = 1 + strongest[height[strongest] > np.log(_PEAK)]
    is_peak = np.asarray(binary_dilation(np.isin(region, peaks), iterations=2))
    edges = np.flatnonzero(np.diff(np.r_[False, is_peak, False].astype(int))).reshape(-1, 2)
    tops = np.array([a + np.argmax(power[a:b]) for a, b in edges], dtype=np.intp)
    width = np.maximum(2.0, 0.3 * (edges[:, 1] - edges[:, 0]))
    return is_peak, frequency_hz[tops], width * (frequency_hz[1] - frequency_hz[0])


def _bands(frequency_hz: FloatArray, step: float) -> IntArray:
    """Return where bands of at least one step begin among the frequencies."""
    band = np.floor(np.cumsum(step / np.maximum(_BAND * frequency_hz, step)) - 1e-9)
    return np.flatnonzero(np.diff(band, prepend=-np.inf) > 0)


def _shapes(square: FloatArray, lowest_hz: float, known: Sequence[FloatArray]) -> FloatArray:
    """Return the shapes of noise, turbulence, wide and known resonances over the bands, (k, b).

    Nothing but noise and the skirts of slower parts has a place at high frequencies: there the
    corrections of a wrong guess show.
    """
    corners = np.geomspace(lowest_hz, _FASTEST_HZ, _CORNERS)
    falls = [(1 + square / corner**2) ** -order for corner in corners for order in _ORDERS]
    bumps = [
        resonance(square, centre, _BUMP_DAMPING) for centre in np.geomspace(*_BUMPS_HZ, _BUMPS)
    ]
    shapes = np.array([np.ones_like(square), *falls, *bumps, *known])
    return np.asarray(shapes / np.max(shapes, axis=1, keepdims=True))


def resonance(square: FloatArray, centre_hz: FloatArray | float, damping: float) -> FloatArray:
    """Return the spectrum of a second-order process, 1 at low frequencies."""
    centre = np.asarray(centre_hz) ** 2
    return np.asarray(centre**2 / ((square - centre) ** 2 + 4 * damping**2 * centre * square))


class CoarseAxis:
    """One axis in bands and at peaks, and fits of shapes to it for repairs of its corrections.

    A fit varies the gain and the logarithms of the amplitudes of the shapes.
    """

    def __init__(
        self,
        frequency_hz: FloatArray,
        measured: ComplexArray,
        guesses: ComplexArray,
        *,
        independent: float,
        frame_rate_hz: float,
        resonances: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Take the powers of an axis from (segments, f) and corrections (n, segments, f).

        ``resonances`` are known ones, by frequency [Hz] and damping ratio.
        """
        power = np.mean(abs(measured) ** 2, axis=0)
        is_peak, lines, width = find_spectral_peaks(frequency_hz, power)
        step = float(frequency_hz[1] - frequency_hz[0])
        every = LoopPeriodogram(
            frequency_hz=frequency_hz,
            measured=power,
            crossed=np.mean((measured.conj() * guesses).real, axis=1),
            corrected=np.mean(guesses.real**2 + guesses.imag**2, axis=1),
            count=np.full(power.size, independent),
            frame_rate_hz=frame_rate_hz,
            resolution_hz=step,
        )
        bands, self.peaks = every.take(~is_peak), every.take(is_peak)
        self.bands = bands.merge(_bands(bands.frequency_hz, step))

        def warp(f: FloatArray) -> FloatArray:
            return half_angle_square(f, frame_rate_hz) * (frame_rate_hz / (2 * np.pi)) ** 2

        # frequency squared, as that of a sampled process [Hz^2], (b,)
        square = warp(self.bands.frequency_hz)
        # only the skirts of a line are compared, which do not show its damping; a line on either
        # side of its peak stands for one between them
        places = np.concatenate([lines - width, lines + width])
        narrow = [*resonances, *((f, _LINE_DAMPING) for f in places if f > 0)]
        skirts = [resonance(square, np.sqrt(warp(np.array(f))), ratio) for f, ratio in narrow]
        self.shapes = _shapes(square, frequency_hz[0], skirts)  # of at most 1, (k, b)

    def fit_profile(self, gains: FloatArray) -> CoarseFit:
        """Fit the spectrum with a single repair at each of its gains (n,)."""
        return self._minimise(gains, np.zeros(gains.size, dtype=np.intp), free=False)

    def fit_guesses(self, starts: FloatArray) -> CoarseFit:
        """Fit spectrum and gain of each repair, from each of its starting gains (repairs, s)."""
        guesses, count = starts.shape
        fits = self._minimise(starts.ravel(), np.repeat(np.arange(guesses), count), free=True)
        best = np.argmin(fits[0].reshape(guesses, count), axis=1) + count * np.arange(guesses)
        contrast, gain, misfit = (values[best] for values in fits)
        return contrast, gain, misfit

    def _minimise(self, gain: FloatArray, guess: IntArray, *, free: bool) -> CoarseFit:
        """Return the least contrast of each row, its gain and its misfit, by damped scoring."""
        theta = self._begin(gain, guess)
        rows = np.arange(gain.size)
        value, damping = self._contrast(theta, guess)[0], np.full(gain.size, 1e-2)
        for _ in range(MOST_STEPS):
            gradient, information = self._derivatives(theta[rows], guess[rows], free=free)
            diagonal = np.einsum("rii->ri", information)
            ridge = damping[rows, None] * diagonal
            ridge += 1e-9 * np.max(diagonal, axis=1, keepdims=True)
            ridge[:, 1:] += 1e-3
            stiff = information + np.eye(theta.shape[1]) * ridge[:, :, None]
            step = -np.linalg.solve(stiff, gradient[:, :, None])[:, :, 0]
            trial = theta[rows] + step
            trial[:, 0] = np.maximum(trial[:, 0], 0.2 * theta[rows, 0])
            trial[:, 1:] = theta[rows, 1:] + np.clip(step[:, 1:], -_LARGEST, _LARGEST)
            level = np.max(trial[:, 1:], axis=1, keepdims=True)
            trial[:, 1:] = np.maximum(trial[:, 1:], level - 40)
            new, _ = self._contrast(trial, guess[rows])
            better = new < value[rows]
            saved = np.where(better, value[rows] - new, np.inf)
            moved = rows[better]
            theta[moved], value[moved] = trial[better], new[better]
            damping[rows] = np.where(better, np.maximum(damping[rows] / 5, 1e-6), damping[rows] * 6)
            rows = rows[(saved > _SETTLED) & (damping[rows] < 1e4)]
            if not rows.size:
                break
        _, ratio = self._contrast(theta, guess)
        deviance = 2 * self.bands.count * (ratio - 1 - np.log(ratio))
        return value, theta[:, 0], np.asarray(np.mean(deviance, axis=1))

    def _begin(self, gain: FloatArray, guess: IntArray) -> FloatArray:
        """Return starting values, with amplitudes by multiplicative updates."""
        shapes = self.shapes
        power, count = _power(self.bands.row(guess), gain), self.bands.count
        level = np.median(power, axis=1)[:, None] / len(shapes)
        a = level / np.mean(shapes, axis=1)
        for _ in range(_FIRST_PASSES):
            model = a @ shapes
            weight = count / model
            a *= np.sqrt(((weight * power / model) @ shapes.T) / (weight @ shapes.T))
            a = np.maximum(a, 1e-12 * np.max(a, axis=1, keepdims=True))
        return np.column_stack([gain, np.log(a)])

    def _contrast(self, theta: FloatArray, guess: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the contrast of each row, and the power of each band over the model's."""
        model = np.exp(theta[:, 1:]) @ self.shapes
        ratio = _power(self.bands.row(guess), theta[:, 0]) / model
        at_peaks = np.log(_power(self.peaks.row(guess), theta[:, 0])) + 1
        total = (np.log(model) + ratio) @ self.bands.count + at_peaks @ self.peaks.count
        return np.asarray(total), ratio

    def _derivatives(
        self, theta: FloatArray, guess: IntArray, *, free: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return gradients (rows, p) and information (rows, p, p) of the contrast."""
        gain, a = theta[:, 0], np.exp(theta[:, 1:])
        model = a @ self.shapes
        bands, peaks = self.bands.row(guess), self.peaks.row(guess)
        by_gain = 2 * (bands.crossed + gain[:, None] * bands.corrected) / model
        at_peaks = 2 * (peaks.crossed + gain[:, None] * peaks.corrected) / _power(peaks, gain)
        count, excess = bands.count, bands.count * (1 - _power(bands, gain) / model)
        n = theta.shape[1]
        gradient, information = np.empty((len(theta), n)), np.empty((len(theta), n, n))
        gradient[:, 0] = by_gain @ count + at_peaks @ peaks.count
        gradient[:, 1:] = a * ((excess / model) @ self.shapes.T)
        information[:, 0, 0] = (bands.corrected / model) @ (2 * count)
        information[:, 0, 0] += at_peaks**2 @ peaks.count
        information[:, 0, 1:] = -a * ((count * by_gain / model) @ self.shapes.T)
        pairs = (self.shapes * (count / model**2)[:, None]) @ self.shapes.T
        information[:, 1:, 1:] = a[:, :, None] * pairs * a[:, None]
        if not free:
            gradient[:, 0] = information[:, 0, 1:] = 0.0
            information[:, 0, 0] = 1.0
        information[:, 1:, 0] = information[:, 0, 1:]
        return gradient, information


def _power(data: LoopPeriodogram, gain: FloatArray) -> FloatArray:
    """Return the power of each row at its gain, (rows, f), above rounding."""
    return np.asarray(np.maximum(data.power(gain[:, None]), _SMALLEST * data.measured))
