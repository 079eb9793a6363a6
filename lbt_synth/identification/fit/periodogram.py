"""Periodograms of a running loop, as functions of the sensor gain.

``y(k) + g c(k)``, with c the correction that the measurement y contains and g the sensor gain,
does not depend on what the loop did. Its periodogram is quadratic in g::

    I(g) = |Y|^2 + 2 g Re(Y C*) + g^2 |C|^2

Turbulence falls so steeply that a plain periodogram leaks. The series are differenced, tapered
at both ends, and the power divided by that of the difference, ``|1 - z^-1|^2``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

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
    """One-sided densities over frequency, of measurements and of the corrections in them.

    The densities are (f,) of one axis and (axes, f) of several. With many guesses of the
    correction, those that contain it are (guesses, f).
    """

    frequency_hz: FloatArray  # (f,), increasing
    measured: FloatArray  # (..., f): |Y|^2 [nm^2/Hz]
    crossed: FloatArray  # (..., f): Re(Y C*) [nm^2/Hz]; zeros without corrections
    corrected: FloatArray  # (..., f): |C|^2 [nm^2/Hz]; zeros without corrections
    count: FloatArray  # (f,): independent periodograms that each value is the mean of
    frame_rate_hz: float
    duration_s: float | None = None  # of the tapered segments; None for a density from elsewhere
    # (2, 2, f): the real part of (Y1, C1) times (Y2, C2)* of two axes [nm^2/Hz]
    between: FloatArray | None = None

    @property
    def closed(self) -> bool:
        """Whether there are corrections."""
        return bool(np.any(self.corrected > 0))

    @cached_property
    def half_angle_square(self) -> FloatArray:
        """``4 sin^2(pi f / f_s)``, (f,)."""
        return half_angle_square(self.frequency_hz, self.frame_rate_hz)

    @cached_property
    def log_frame_mean(self) -> FloatArray:
        """Logarithm of the power that the mean over a frame leaves, (f,)."""
        return np.asarray(2 * np.log(np.sinc(self.frequency_hz / self.frame_rate_hz)))

    @cached_property
    def step_hz(self) -> float:
        """Distance of neighbouring frequencies."""
        return float(np.median(np.diff(self.frequency_hz)))

    @property
    def angle_s(self) -> float:
        """Angle per frame of 1 Hz."""
        return 2 * np.pi / self.frame_rate_hz

    def row(self, i: int | IntArray) -> LoopPeriodogram:
        """Return the periodogram of some of several axes or guesses."""
        measured = self.measured if self.measured.ndim == 1 else self.measured[i]
        crossed, corrected = self.crossed[i], self.corrected[i]
        return replace(self, measured=measured, crossed=crossed, corrected=corrected, between=None)

    def power(self, gain: float | FloatArray) -> FloatArray:
        """Return the density of ``y + gain c`` [nm^2/Hz], (..., f); gains are (..., 1)."""
        return np.asarray(self.measured + gain * (2 * self.crossed + gain * self.corrected))

    def matrix(self, gains: FloatArray) -> FloatArray:
        """Return the real density of ``y + g c`` of axes at their gains (n,) [nm^2/Hz], (n, n, f).

        Its imaginary part says nothing about lines that move along a direction.
        """
        if self.between is None:
            return self.power(float(gains[0]))[None, None]
        crossed = np.einsum("i,ijf,j->f", [1.0, gains[0]], self.between, [1.0, gains[1]])
        first, second = self.power(gains[:, None])
        return np.array([[first, crossed], [crossed, second]])

    def merge(self, widths_hz: FloatArray) -> LoopPeriodogram:
        """Return the means over groups of neighbours of these widths (f,), or single ones."""
        step = self.step_hz
        group = np.floor(np.cumsum(step / np.maximum(step, widths_hz)) - 1e-9)
        starts = np.flatnonzero(np.diff(group, prepend=-np.inf) > 0)
        size = np.diff(np.append(starts, len(self.frequency_hz)))
        means = self._map(lambda values: np.add.reduceat(values, starts, axis=-1) / size)
        return replace(means, count=np.add.reduceat(self.count, starts))

    def take(self, inside: BoolArray | slice) -> LoopPeriodogram:
        """Return the values at some frequencies."""
        return replace(self._map(lambda values: values[..., inside]), count=self.count[inside])

    def _map(self, change: Callable[[Any], Any]) -> LoopPeriodogram:
        """Return the periodogram with its frequencies and densities changed."""
        names = ("frequency_hz", "measured", "crossed", "corrected")
        values: Any = {name: change(getattr(self, name)) for name in names}
        between = None if self.between is None else change(self.between)
        return replace(self, **values, between=between)


def half_angle_square(frequency_hz: FloatArray, frame_rate_hz: float) -> FloatArray:
    """Return ``4 sin^2(pi f / f_s)``, the power of the difference of two frames."""
    return np.asarray(4 * np.sin(np.pi * frequency_hz / frame_rate_hz) ** 2)


def segment_transforms(
    series: FloatArray, rows: IntArray, frame_rate_hz: float, *, levelled: bool = False
) -> tuple[FloatArray, ComplexArray, float]:
    """Return frequencies (f,), scaled transforms ([n,] segments, f) and independent values of each.

    The series is (frames,) or (frames, n), its segments (segments, length) of frames. It is
    differenced and tapered. Where it is to be ``levelled``, it loses its mean slope, and nothing is
    padded. The square of a transform is a one-sided density.
    """
    from scipy.fft import next_fast_len, rfft

    length = rows.shape[1] - 1
    taper, size = tukey(length), length if levelled else int(next_fast_len(length, real=True))
    frequency: FloatArray = np.arange(1.0, (size + 1) // 2) * (frame_rate_hz / size)
    scale = np.sqrt(2 / frame_rate_hz / np.sum(taper**2))
    scale = scale / np.sqrt(half_angle_square(frequency, frame_rate_hz))
    steps = np.diff(np.ascontiguousarray(series.T)[..., rows])
    if levelled:
        steps -= np.mean(steps, axis=-1, keepdims=True)
    transforms = scale * rfft(taper * steps, size)[..., 1 : (size + 1) // 2]
    # neighbours of a padded or tapered transform are not independent
    independent = len(rows) * np.sum(taper**2) ** 2 / np.sum(taper**4) / size
    return frequency, np.asarray(transforms), float(independent)


def loop_periodogram(
    measurement: FloatArray,
    correction: FloatArray | None,
    *,
    frame_rate_hz: float,
    stretches: Sequence[tuple[int, int]],
) -> LoopPeriodogram:
    """Return the periodogram of one axis, series (frames,), or of two, (frames, 2).

    Segments of one length are cut from all usable stretches. That length uses most of the data,
    and is the whole stretch where there is one of at most 2^16 frames.
    """
    length = _segment_length([stop - start for start, stop in stretches])
    starts: list[int] = []
    for start, stop in stretches:
        many, spare = divmod(stop - start, length)
        starts += [start + int(spare * (i + 0.5) / many) + i * length for i in range(many)]
    rows = np.array(starts)[:, None] + np.arange(length)
    frequency, y, independent = segment_transforms(measurement, rows, frame_rate_hz)
    c = np.zeros_like(y)
    if correction is not None:
        _, c, _ = segment_transforms(correction, rows, frame_rate_hz)
    measured = np.mean(np.abs(y) ** 2, axis=-2)
    between = None
    if measurement.ndim > 1:
        first, second = np.stack([y, c], axis=1)
        between = np.mean((first[:, None] * second.conj()).real, axis=-2)
    return LoopPeriodogram(
        frequency_hz=frequency,
        measured=measured + _FLOOR * np.mean(measured, axis=-1, keepdims=True),
        crossed=np.mean((y * c.conj()).real, axis=-2),
        corrected=np.mean(np.abs(c) ** 2, axis=-2),
        count=np.full(frequency.size, independent),
        frame_rate_hz=frame_rate_hz,
        duration_s=(length - 1) / frame_rate_hz,
        between=between,
    )


def _segment_length(lengths: list[int]) -> int:
    """Return the length of segments that uses most frames, the longest of equal ones."""
    parts = {length // pieces for length in lengths for pieces in range(1, 9)}
    c = np.array(sorted(p for p in parts | {_LONGEST_SEGMENT} if p >= SHORTEST_SEGMENT))
    c = c[c <= _LONGEST_SEGMENT]
    used = np.sum(np.array(lengths)[:, None] // c * c, axis=0)
    # a tenth of the data is a fair price for a resolution twice as fine
    return int(c[np.argmax(used / np.max(used) + 0.1 * np.log2(c / _LONGEST_SEGMENT))])
