"""A coarse spectrum of the pseudo-open loop, for many guesses of its corrections at once.

The measurement is ``y = z - g c``, with z what an open loop would have measured and c the
correction. Each guess of c gives another z, and z has a simple spectrum only if the guess is
right: white noise, turbulence that falls, a few resonances, lines with their skirts. The
likelihood is Whittle's, as in the fit of the model; its Jacobian is 1 because c follows from the
past of y.

Frequencies are merged into bands, except around peaks. There each frequency has a power of its
own: a band without a model still counts, because a wrong filter that makes one band smaller makes
another larger (Jensen's formula).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.identification.fit.periodogram import (
    LoopPeriodogram,
    half_angle_square,
    tukey,
)
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

_SEGMENT_S = 6.0
_SHORTEST = 512  # frames of a segment, where the record has them
_MOST_SEGMENTS = 24
_BAND, _WIDEST_BAND = 0.06, 0.02  # of its frequency, and of the frame rate
_SLOWEST_HZ, _FASTEST_HZ = 0.15, 6.0  # corners of the turbulence
_CORNERS, _ORDERS = 5, (1, 2, 3)  # slopes of -2, -4, -6
_BUMPS_HZ, _BUMPS, _BUMP_DAMPING = (1.5, 25.0), 8, 0.18
_LINE_DAMPING = 0.004  # only the skirts of a line are compared, which do not show it
_SMALLEST = 1e-9  # of the measured power
_FIRST_PASSES, _MOST_PASSES, _SETTLED = 20, 40, 0.05
_LARGEST = 2.0  # step of the logarithm of an amplitude
_PEAK, _SKIRT = 3.0, 1.25  # over the surroundings
_SURROUNDINGS, _REACH, _MOST_PEAKS = 81, 40, 16  # frequencies, frequencies, peaks
_APART = 4  # frequencies between peaks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoarseAxis:
    """Powers of one axis in bands and at peaks, and the shapes that may explain them."""

    bands: LoopPeriodogram  # of all guesses
    peaks: LoopPeriodogram  # the same at the frequencies of peaks
    shapes: FloatArray  # (k, b): noise, turbulence and resonances, at most 1
    square: FloatArray  # (b,): frequency squared, warped as that of a sampled process [Hz^2]
    lines: FloatArray  # (l,): logarithms of the frequencies of the peaks
    line_width: FloatArray  # (l,): how far each may be off


def segment_transforms(
    series: FloatArray, stretches: Sequence[tuple[int, int]], frame_rate_hz: float
) -> tuple[FloatArray, ComplexArray, float]:
    """Return frequencies (f,), scaled transforms (n, segments, f) and independent values of each.

    The series (frames, n) is differenced, as in the periodogram of the fit, and loses its mean
    slope. The square of a transform is a one-sided density.
    """
    from scipy.fft import rfft

    longest = max(stop - start for start, stop in stretches)
    usual = max(_SEGMENT_S * frame_rate_hz, _SHORTEST)
    length = int(min(usual, max(longest // 2, _SHORTEST), longest))
    starts = [
        start + i * length for start, stop in stretches for i in range((stop - start) // length)
    ]
    chosen = np.unique(np.linspace(0, len(starts) - 1, _MOST_SEGMENTS).astype(np.intp))
    rows = np.array(starts)[chosen][:, None] + np.arange(length)
    taper, size = tukey(length - 1), length - 1
    frequency: FloatArray = np.arange(1.0, (size + 1) // 2) * (frame_rate_hz / size)
    scale = np.sqrt(2 / frame_rate_hz / np.sum(taper**2))
    scale = scale / np.sqrt(half_angle_square(frequency, frame_rate_hz))
    steps = np.diff(np.ascontiguousarray(series.T)[:, rows])
    steps -= np.mean(steps, axis=-1, keepdims=True)
    steps *= taper
    transforms = rfft(steps)[..., 1 : (size + 1) // 2]
    independent = len(rows) * np.sum(taper**2) ** 2 / np.sum(taper**4) / size
    return frequency, transforms * scale, float(independent)


def coarse_axis(
    frequency_hz: FloatArray,
    measured: ComplexArray,
    guesses: ComplexArray,
    *,
    independent: float,
    frame_rate_hz: float,
    resonances: Sequence[tuple[float, float]] = (),
) -> CoarseAxis:
    """Return the powers of one axis, given (segments, f) and guesses (n, segments, f).

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
    bands = every.take(~is_peak)
    bands = bands.merge(_bands(bands.frequency_hz, frame_rate_hz, step))

    def warp(f: FloatArray) -> FloatArray:
        return half_angle_square(f, frame_rate_hz) * (frame_rate_hz / (2 * np.pi)) ** 2

    square = warp(bands.frequency_hz)
    known = [resonance(square, np.sqrt(warp(np.array(f))), ratio) for f, ratio in resonances]
    return CoarseAxis(
        bands=bands,
        peaks=every.take(is_peak),
        shapes=_background_shapes(square, frequency_hz[0], known),
        square=square,
        lines=np.log(lines),
        line_width=width,
    )


def find_spectral_peaks(
    frequency_hz: FloatArray, power: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the frequencies at peaks (f,), where the peaks are (l,), and their widths (l,)."""
    from scipy.ndimage import median_filter
    from scipy.signal import find_peaks

    log = np.log(np.convolve(np.pad(power, 1, mode="edge"), np.full(3, 1 / 3), mode="valid"))
    above = log - median_filter(log, size=_SURROUNDINGS, mode="nearest")
    tops, _ = find_peaks(above, height=float(np.log(_PEAK)), distance=_APART)
    is_peak = np.zeros(power.size, dtype=np.bool_)
    for top in tops[np.argsort(-above[tops], kind="stable")][:_MOST_PEAKS]:
        low, high = max(top - _REACH, 0), min(top + _REACH + 1, power.size)
        ends = np.flatnonzero(above[low:high] <= np.log(_SKIRT)) + low
        start = np.max(ends[ends < top], initial=low)
        stop = np.min(ends[ends > top], initial=high - 1)
        is_peak[max(start - 1, 0) : stop + 2] = True
    edges = np.flatnonzero(np.diff(np.r_[False, is_peak, False].astype(int))).reshape(-1, 2)
    lines = np.array([frequency_hz[a + np.argmax(power[a:b])] for a, b in edges])
    step = frequency_hz[1] - frequency_hz[0]
    width = np.array([max(2.0, 0.3 * (b - a)) * step for a, b in edges])
    return is_peak, lines, width / lines


def _bands(frequency_hz: FloatArray, frame_rate_hz: float, step: float) -> IntArray:
    """Return where bands of at least one step begin among the frequencies."""
    width = np.minimum(_BAND * frequency_hz, _WIDEST_BAND * frame_rate_hz)
    band = np.floor(np.cumsum(step / np.maximum(width, step)) - 1e-9)
    return np.flatnonzero(np.diff(band, prepend=-np.inf) > 0)


def _background_shapes(
    square: FloatArray, lowest_hz: float, known: Sequence[FloatArray]
) -> FloatArray:
    """Return the shapes of noise, turbulence and wide resonances over the bands, (k, b).

    Nothing but noise and the skirts of slower parts has a place at high frequencies: there the
    corrections of a wrong guess show.
    """
    corners = np.geomspace(max(lowest_hz / 2, _SLOWEST_HZ), _FASTEST_HZ, _CORNERS)
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


# minus the logarithm of the likelihood of each guess, its best gain, and its misfit: the mean
# deviance of a band, about 1 if the shapes suffice; (guesses,) each
CoarseFit = tuple[FloatArray, FloatArray, FloatArray]


def fit_profile(axis: CoarseAxis, gains: FloatArray) -> CoarseFit:
    """Fit the spectrum of an axis with a single guess at each of its gains (n,)."""
    return _Fit(axis, np.zeros(gains.size, dtype=np.int64), free=False).minimise(gains)


def fit_guesses(axis: CoarseAxis, starts: FloatArray) -> CoarseFit:
    """Fit spectrum and gain of each guess, from each of its starting gains (guesses, s)."""
    guesses, each = starts.shape
    fits = _Fit(axis, np.repeat(np.arange(guesses), each), free=True).minimise(starts.ravel())
    best = np.argmin(fits[0].reshape(guesses, each), axis=1) + each * np.arange(guesses)
    contrast, gain, misfit = (values[best] for values in fits)
    return contrast, gain, misfit


class _Fit:
    """Fits of all guesses of one axis: gain, logarithms of the amplitudes, places of the lines."""

    def __init__(self, axis: CoarseAxis, guess: IntArray, free: bool) -> None:
        self.axis, self.guess, self.free = axis, guess, free
        self.fixed, self.lines = len(axis.shapes), axis.lines.size
        self.amplitudes = self.fixed + self.lines
        upper = np.triu_indices(self.fixed)
        self.pairs = (axis.shapes[upper[0]] * axis.shapes[upper[1]]).T
        self.pair = np.zeros((self.fixed, self.fixed), dtype=np.intp)  # the place of each there
        self.pair[upper] = self.pair.T[upper] = np.arange(upper[0].size)

    def minimise(self, gain: FloatArray) -> CoarseFit:
        """Return the least contrast of each row, by damped scoring."""
        theta = self._begin(gain)
        rows = np.arange(gain.size)
        value, damping = self._contrast(theta, rows), np.full(gain.size, 1e-2)
        for _ in range(_MOST_PASSES):
            gradient, information = self._derivatives(theta[rows], rows)
            diagonal = np.einsum("rii->ri", information)
            more = damping[rows, None] * diagonal
            more += 1e-9 * np.max(diagonal, axis=1, keepdims=True)
            more[:, 1 : 1 + self.amplitudes] += 1e-3
            stiff = information + np.eye(theta.shape[1]) * more[:, :, None]
            step = -np.linalg.solve(stiff, gradient[:, :, None])[:, :, 0]
            trial = self._limit(theta[rows], step)
            new = self._contrast(trial, rows)
            better = new < value[rows]
            saved = np.where(better, value[rows] - new, np.inf)
            moved = rows[better]
            theta[moved], value[moved] = trial[better], new[better]
            damping[rows] = np.where(better, np.maximum(damping[rows] / 5, 1e-6), damping[rows] * 6)
            rows = rows[(saved > _SETTLED) & (damping[rows] < 1e4)]
            if not rows.size:
                break
        return value, theta[:, 0], self._misfit(theta)

    def _misfit(self, theta: FloatArray) -> FloatArray:
        """Return the mean deviance of the bands of each row."""
        gain, model, *_ = self._model(theta)
        bands = self.axis.bands
        ratio = _power(bands.row(self.guess), gain) / model
        return np.asarray(np.mean(2 * bands.count * (ratio - 1 - np.log(ratio)), axis=1))

    def _begin(self, gain: FloatArray) -> FloatArray:
        """Return starting values, with amplitudes by multiplicative updates."""
        skirts, _ = self._skirts(self.axis.lines[None])
        shapes = np.vstack([self.axis.shapes, skirts[0]])
        power, count = _power(self.axis.bands.row(self.guess), gain), self.axis.bands.count
        level = np.median(power, axis=1)[:, None] / self.amplitudes
        a = level / np.mean(shapes, axis=1)
        for _ in range(_FIRST_PASSES):
            model = a @ shapes
            weight = count / model
            a *= np.sqrt(((weight * power / model) @ shapes.T) / (weight @ shapes.T))
            a = np.maximum(a, 1e-12 * np.max(a, axis=1, keepdims=True))
        return np.column_stack([gain, np.log(a), np.tile(self.axis.lines, (gain.size, 1))])

    def _skirts(self, lines: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the shapes of lines (rows, l, b), and their log derivatives by their places."""
        square = self.axis.square
        centre = np.exp(lines)[:, :, None]
        skirt = 1e-3 * resonance(square, centre, _LINE_DAMPING)
        shift = square - centre**2
        stretch = 4 * _LINE_DAMPING**2 * centre**2 * square
        return skirt, 4 - (2 * stretch - 4 * centre**2 * shift) / (shift**2 + stretch)

    def _model(
        self, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return gains (rows,), models (rows, b), amplitudes, the parts of lines and their slopes.

        The amplitudes are those of the shapes that all rows share, (rows, k); parts and slopes are
        (rows, l, b).
        """
        a = np.exp(theta[:, 1 : 1 + self.amplitudes])
        skirt, slope = self._skirts(theta[:, 1 + self.amplitudes :])
        skirt *= a[:, self.fixed :, None]
        model = a[:, : self.fixed] @ self.axis.shapes + np.sum(skirt, axis=1)
        return theta[:, 0], model, a[:, : self.fixed], skirt, slope

    def _away(self, theta: FloatArray) -> FloatArray:
        """Return how far lines are from their peaks, over their widths, (rows, l)."""
        away = theta[:, 1 + self.amplitudes :] - self.axis.lines
        return np.asarray(away / self.axis.line_width)

    def _contrast(self, theta: FloatArray, rows: IntArray) -> FloatArray:
        """Return the contrast of each row."""
        axis, guess = self.axis, self.guess[rows]
        gain, model, *_ = self._model(theta)
        ratio = _power(axis.bands.row(guess), gain) / model
        at_peaks = np.log(_power(axis.peaks.row(guess), gain)) + 1
        return np.asarray(
            (np.log(model) + ratio) @ axis.bands.count
            + at_peaks @ axis.peaks.count
            + 0.5 * np.sum(self._away(theta) ** 2, axis=1)
        )

    def _derivatives(self, theta: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return gradients (rows, p) and information (rows, p, p) of the contrast.

        What the shapes that all rows share add is a product of two matrices.
        """
        axis, guess = self.axis, self.guess[rows]
        gain, model, a, skirt, slope = self._model(theta)
        bands, peaks = axis.bands.row(guess), axis.peaks.row(guess)
        by_gain = 2 * (bands.crossed + gain[:, None] * bands.corrected) / model
        at_peaks = 2 * (peaks.crossed + gain[:, None] * peaks.corrected) / _power(peaks, gain)
        count, excess = bands.count, bands.count * (1 - _power(bands, gain) / model)
        share = skirt / model[:, None]
        own = np.concatenate([share, share * slope], axis=1)  # of lines, by power and place
        weighted = own * count
        n, k = theta.shape[1], 1 + self.fixed
        gradient, information = np.empty((len(rows), n)), np.empty((len(rows), n, n))
        gradient[:, 0] = by_gain @ count + at_peaks @ peaks.count
        gradient[:, 1:k] = a * ((excess / model) @ axis.shapes.T)
        gradient[:, k:] = (own @ excess[:, :, None])[:, :, 0]
        information[:, 0, 0] = (bands.corrected / model) @ (2 * count)
        information[:, 0, 0] += at_peaks**2 @ peaks.count
        information[:, 0, 1:k] = -a * ((count * by_gain / model) @ axis.shapes.T)
        information[:, 0, k:] = -(weighted @ by_gain[:, :, None])[:, :, 0]
        pairs = ((count / model**2) @ self.pairs)[:, self.pair]
        information[:, 1:k, 1:k] = a[:, :, None] * pairs * a[:, None]
        information[:, k:, 1:k] = ((weighted / model[:, None]) @ axis.shapes.T) * a[:, None]
        information[:, 1:k, k:] = information[:, k:, 1:k].transpose(0, 2, 1)
        information[:, k:, k:] = weighted @ own.transpose(0, 2, 1)
        information[:, 1:, 0] = information[:, 0, 1:]
        if not self.free:
            gradient[:, 0] = information[:, 0, 1:] = information[:, 1:, 0] = 0.0
            information[:, 0, 0] = 1.0
        places = range(1 + self.amplitudes, n)
        gradient[:, places] += self._away(theta) / axis.line_width
        information[:, places, places] += 1 / axis.line_width**2
        return gradient, information

    def _limit(self, theta: FloatArray, step: FloatArray) -> FloatArray:
        """Return the parameters after a step, each of bounded size, the gain still above 0."""
        k = 1 + self.amplitudes
        trial = theta + step
        trial[:, 0] = np.maximum(trial[:, 0], 0.2 * theta[:, 0])
        trial[:, 1:k] = theta[:, 1:k] + np.clip(step[:, 1:k], -_LARGEST, _LARGEST)
        width = self.axis.line_width
        trial[:, k:] = theta[:, k:] + np.clip(step[:, k:], -width, width)
        level = np.max(trial[:, 1:k], axis=1, keepdims=True)
        trial[:, 1:k] = np.maximum(trial[:, 1:k], level - 40)
        return trial


def _power(data: LoopPeriodogram, gain: FloatArray) -> FloatArray:
    """Return the power of each row at its gain, (rows, f), above rounding."""
    return np.asarray(np.maximum(data.power(gain[:, None]), _SMALLEST * data.measured))
