"""Periodograms of a running loop, as functions of the sensor gain.

``y(k) + g c(k)``, with c the correction that the measurement y contains and g the sensor gain,
does not depend on what the loop did. Its periodogram is quadratic in g::

    I(g) = |Y|^2 + 2 g Re(Y C*) + g^2 |C|^2

Turbulence falls so steeply that a plain periodogram leaks. The series are differenced, tapered
at both ends, and the power divided by that of the difference, ``|1 - z^-1|^2``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lbt_synth.validation import ComplexArray, FloatArray, IntArray

TAPER = 0.1  # of a segment, both ends together
SHORTEST_SEGMENT = 256
_LONGEST_SEGMENT = 1 << 16
_FLOOR = 1e-12  # of the mean density: below, there is nothing but rounding


def tukey(length: int) -> FloatArray:
    """Return the taper of a segment, a cosine at either end."""
    edge = np.minimum(np.arange(length), np.arange(length)[::-1]) / (TAPER / 2 * (length - 1))
    return np.asarray(np.sin(np.pi / 2 * np.minimum(edge, 1)) ** 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopPeriodogram:
    """One-sided densities over frequency, of the measurement and of the correction in it."""

    frequency_hz: FloatArray  # (f,), increasing
    measured: FloatArray  # (f,): |Y|^2 [nm^2/Hz]
    crossed: FloatArray  # (f,): Re(Y C*) [nm^2/Hz]; zeros without corrections
    corrected: FloatArray  # (f,): |C|^2 [nm^2/Hz]; zeros without corrections
    count: FloatArray  # (f,): independent periodograms that each value is the mean of
    frame_rate_hz: float
    resolution_hz: float  # width of a frequency bin of the transform
    duration_s: float | None = None  # of the tapered segments; None for a density from elsewhere

    @property
    def closed(self) -> bool:
        """Whether there are corrections."""
        return bool(np.any(self.corrected > 0))

    @cached_property
    def half_angle_square(self) -> FloatArray:
        """``4 sin^2(pi f / f_s)``, (f,)."""
        return half_angle_square(self.frequency_hz, self.frame_rate_hz)

    @cached_property
    def periods(self) -> FloatArray:
        """Periods of each frequency within a tapered segment, (f,)."""
        assert self.duration_s is not None
        return self.frequency_hz * self.duration_s

    @cached_property
    def step_hz(self) -> float:
        """Distance of neighbouring frequencies."""
        return float(np.median(np.diff(self.frequency_hz)))

    @property
    def angle_s(self) -> float:
        """Angle per frame of 1 Hz."""
        return 2 * np.pi / self.frame_rate_hz

    def power(self, gain: float) -> FloatArray:
        """Return the density of ``y + gain c`` [nm^2/Hz], (f,)."""
        return np.asarray(self.measured + gain * (2 * self.crossed + gain * self.corrected))

    def power_slopes(self, gain: float) -> tuple[FloatArray, FloatArray]:
        """Return the first two derivatives of that density by the logarithm of the gain, (f,)."""
        cross, square = 2 * gain * self.crossed, 2 * gain**2 * self.corrected
        return cross + square, cross + 2 * square

    def merge(self, starts: IntArray) -> LoopPeriodogram:
        """Return the means over groups of neighbours that begin at these indices."""
        size = np.diff(np.append(starts, len(self.frequency_hz)))
        names = ("frequency_hz", "measured", "crossed", "corrected")
        means: Any = {name: np.add.reduceat(getattr(self, name), starts) / size for name in names}
        return replace(self, **means, count=np.add.reduceat(self.count, starts))

    def window(self, low_hz: float, high_hz: float) -> LoopPeriodogram:
        """Return the values between two frequencies."""
        inside = slice(*np.searchsorted(self.frequency_hz, [low_hz, high_hz]))
        names = ("frequency_hz", "measured", "crossed", "corrected", "count")
        values: Any = {name: getattr(self, name)[inside] for name in names}
        return replace(self, **values)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Whiteness:
    """Tests of the innovations, whose spectrum is the ratio of periodogram to model.

    The cumulative periodogram is tested by Kolmogorov's distribution (M. S. Bartlett, An
    Introduction to Stochastic Processes, 1955), the autocorrelation by Box and Pierce's sum of
    squares (doi:10.1080/01621459.1970.10481180).
    """

    deviation: float  # largest distance of the cumulative periodogram from the diagonal
    p_value: float  # probability of a larger one if the innovations were white
    autocorrelation: FloatArray  # (lags,), from lag 1
    correlation_p_value: float  # of the sum of squares over these lags
    frequency_hz: FloatArray  # (f,)
    cumulative: FloatArray  # (f,), from 0 to 1
    effective: float  # number of independent values

    @property
    def white(self) -> bool:
        """Whether neither test refuses whiteness at 1 %."""
        return self.p_value > 0.01 and self.correlation_p_value > 0.01


def half_angle_square(frequency_hz: FloatArray, frame_rate_hz: float) -> FloatArray:
    """Return ``4 sin^2(pi f / f_s)``, the power of the difference of two frames."""
    return np.asarray(4 * np.sin(np.pi * frequency_hz / frame_rate_hz) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Segments:
    """Segments of one length, cut from all stretches, and their transform."""

    rows: IntArray  # (segments, length): frames
    taper: FloatArray  # (length - 1,)
    size: int  # of the transform
    scale: FloatArray  # (f,): from squared moduli to densities
    frequency_hz: FloatArray  # (f,)

    @classmethod
    def cut(cls, stretches: Sequence[tuple[int, int]], frame_rate_hz: float) -> _Segments:
        """Cut the segments; that length uses most of the data."""
        from scipy.fft import next_fast_len

        length = _segment_length([stop - start for start, stop in stretches])
        starts: list[int] = []
        for start, stop in stretches:
            many, spare = divmod(stop - start, length)
            starts += [start + int(spare * (i + 0.5) / many) + i * length for i in range(many)]
        taper = tukey(length - 1)
        size = int(next_fast_len(length - 1, real=True))
        frequency: FloatArray = np.arange(1.0, (size + 1) // 2) * (frame_rate_hz / size)
        scale = 2 / frame_rate_hz / np.sum(taper**2) / half_angle_square(frequency, frame_rate_hz)
        return cls(np.array(starts)[:, None] + np.arange(length), taper, size, scale, frequency)

    def transform(self, series: FloatArray) -> ComplexArray:
        """Return the transform of the differences of a series (frames,), (segments, f)."""
        from scipy.fft import rfft

        tapered = self.taper * np.diff(series[self.rows], axis=1)
        return np.asarray(rfft(tapered, self.size, axis=1)[:, 1 : (self.size + 1) // 2])


def loop_periodogram(
    measurement: FloatArray,
    correction: FloatArray | None,
    *,
    frame_rate_hz: float,
    stretches: Sequence[tuple[int, int]],
) -> LoopPeriodogram:
    """Return the periodogram of one axis, series (frames,), over its usable stretches.

    Segments of one length are cut from all stretches. That length uses most of the data, and is
    the whole stretch where there is one of at most 2^16 frames.
    """
    segments = _Segments.cut(stretches, frame_rate_hz)
    count, length = segments.rows.shape
    frequency, taper, scale = segments.frequency_hz, segments.taper, segments.scale
    y = segments.transform(measurement)
    c = np.zeros_like(y) if correction is None else segments.transform(correction)
    measured = scale * np.mean(np.abs(y) ** 2, axis=0)
    # neighbours of a padded or tapered transform are not independent
    independent = count * np.sum(taper**2) ** 2 / np.sum(taper**4) / segments.size
    return LoopPeriodogram(
        frequency_hz=frequency,
        measured=measured + _FLOOR * np.mean(measured),
        crossed=scale * np.mean((y * c.conj()).real, axis=0),
        corrected=scale * np.mean(np.abs(c) ** 2, axis=0),
        count=np.full(frequency.size, independent),
        frame_rate_hz=frame_rate_hz,
        resolution_hz=frame_rate_hz / length,
        duration_s=(length - 1) / frame_rate_hz,
    )


def cross_periodogram(
    first: FloatArray,
    second: FloatArray,
    *,
    frame_rate_hz: float,
    stretches: Sequence[tuple[int, int]],
) -> ComplexArray:
    """Return the cross-periodogram ``Z1 Z2*`` of two series (frames,), (f,).

    Its frequencies are those of :func:`loop_periodogram` over the same stretches.
    """
    segments = _Segments.cut(stretches, frame_rate_hz)
    product = segments.transform(first) * segments.transform(second).conj()
    return np.asarray(segments.scale * np.mean(product, axis=0))


def _segment_length(lengths: list[int]) -> int:
    """Return the length of segments that uses most frames, the longest of equal ones."""
    parts = {length // part for length in lengths for part in range(1, 9)}
    c = np.array(sorted(p for p in parts | {_LONGEST_SEGMENT} if p >= SHORTEST_SEGMENT))
    c = c[c <= _LONGEST_SEGMENT]
    used = np.sum(np.array(lengths)[:, None] // c * c, axis=0)
    # a tenth of the data is a fair price for a resolution twice as fine
    return int(c[np.argmax(used / np.max(used) + 0.1 * np.log2(c / _LONGEST_SEGMENT))])
