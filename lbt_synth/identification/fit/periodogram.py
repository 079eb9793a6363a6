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

from lbt_synth.identification.fit.taper import tukey
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

_FLOOR = 1e-12  # of the mean density: below, there is nothing but rounding
_LONGEST_SEGMENT = 1 << 16
SHORTEST_SEGMENT = 256


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

    def merge(self, starts: IntArray) -> LoopPeriodogram:
        """Return the means over groups of neighbours that begin at these indices."""
        size = np.diff(np.append(starts, len(self.frequency_hz)))
        names = ("frequency_hz", "measured", "crossed", "corrected")
        means: Any = {name: np.add.reduceat(getattr(self, name), starts) / size for name in names}
        return replace(self, **means, count=np.add.reduceat(self.count, starts))


def half_angle_square(frequency_hz: FloatArray, frame_rate_hz: float) -> FloatArray:
    """Return ``4 sin^2(pi f / f_s)``, the power of the difference of two frames."""
    return np.asarray(4 * np.sin(np.pi * frequency_hz / frame_rate_hz) ** 2)


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
    from scipy.fft import next_fast_len, rfft

    length = _segment_length([stop - start for start, stop in stretches])
    starts: list[int] = []
    for start, stop in stretches:
        many, spare = divmod(stop - start, length)
        starts += [start + int(spare * (i + 0.5) / many) + i * length for i in range(many)]
    rows = np.array(starts)[:, None] + np.arange(length)
    taper = tukey(length - 1)
    size = int(next_fast_len(length - 1, real=True))
    frequency: FloatArray = np.arange(1.0, (size + 1) // 2) * (frame_rate_hz / size)
    scale = 2 / frame_rate_hz / np.sum(taper**2) / half_angle_square(frequency, frame_rate_hz)

    def transform(series: FloatArray) -> ComplexArray:
        tapered = taper * np.diff(series[rows], axis=1)
        return np.asarray(rfft(tapered, size, axis=1)[:, 1 : (size + 1) // 2])

    y = transform(measurement)
    c = np.zeros_like(y) if correction is None else transform(correction)
    measured = scale * np.mean(np.abs(y) ** 2, axis=0)
    # neighbours of a padded or tapered transform are not independent
    independent = len(starts) * np.sum(taper**2) ** 2 / np.sum(taper**4) / size
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


def _segment_length(lengths: list[int]) -> int:
    """Return the length of segments that uses most frames, the longest of equal ones."""
    parts = {length // part for length in lengths for part in range(1, 9)}
    c = np.array(sorted(p for p in parts | {_LONGEST_SEGMENT} if p >= SHORTEST_SEGMENT))
    c = c[c <= _LONGEST_SEGMENT]
    used = np.sum(np.array(lengths)[:, None] // c * c, axis=0)
    # a tenth of the data is a fair price for a resolution twice as fine
    return int(c[np.argmax(used / np.max(used) + 0.1 * np.log2(c / _LONGEST_SEGMENT))])
