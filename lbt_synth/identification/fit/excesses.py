"""Bands in which a spectrum has more power than its model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.validation import FloatArray

_WIDEST = 0.3  # band, of its frequency


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """An excess of power in a band."""

    frequency_hz: float  # where it is highest
    half_width_hz: float  # at half height
    variance_nm2: float  # of a resonance of that height and width
    evidence: float  # log-likelihood that a model with the mean of the band would add


def find_candidates(
    data: LoopPeriodogram, power: FloatArray, model: FloatArray, *, least: float, most: int
) -> list[Candidate]:
    """Find the bands with the most significant excess of power over a model.

    Bands of 1, 2, 4, ... bins are tried everywhere, at steps of a quarter of their width. A band of
    n values with the mean ratio R of power to model would gain ``n (R - 1 - log R)``.
    """
    f, step = data.frequency_hz, data.step_hz
    ratio = np.cumsum(np.append(0.0, power / model))
    weight = np.cumsum(np.append(0.0, data.count))
    found: list[tuple[float, int, int]] = []
    width = 1
    while width * step < _WIDEST * f[-1] and width < f.size:
        starts = np.arange(0, f.size - width + 1, max(1, width // 4))
        widest = np.maximum(_WIDEST * f[starts + width // 2], 4 * step)
        starts = starts[width * step <= widest]
        mean = np.maximum((ratio[starts + width] - ratio[starts]) / width, 1)
        gain = (weight[starts + width] - weight[starts]) * (mean - 1 - np.log(mean))
        best = np.argsort(gain)[::-1][: 8 * most]
        best = best[gain[best] > least]
        found += [(float(gain[i]), int(starts[i]), int(starts[i]) + width) for i in best]
        width *= 2
    apart: list[tuple[float, int, int]] = []
    for worth, start, stop in sorted(found, reverse=True):
        reach = max(3, stop - start)
        if all(start >= b + reach or stop <= a - reach for _, a, b in apart):
            apart.append((worth, start, stop))
    return [
        measure_excess(data, power, model, start, stop, worth)
        for worth, start, stop in apart[:most]
    ]


def measure_excess(
    data: LoopPeriodogram,
    power: FloatArray,
    model: FloatArray,
    start: int,
    stop: int,
    evidence: float = 0.0,
) -> Candidate:
    """Measure place, half width and variance of the highest excess between two bins."""
    excess = power[start:stop] - model[start:stop]
    count = max(1, (stop - start) // 2).bit_length()
    each = [(2**k, _moving_mean(excess, 2**k)) for k in range(count)]
    # the smoothing at which the peak is highest over its scatter, which falls with its root
    _, smooth = max(each, key=lambda one: float(np.max(one[1])) * np.sqrt(one[0]))
    peak = int(np.argmax(smooth))
    low_enough = np.flatnonzero(smooth <= 0.5 * smooth[peak])
    low = low_enough[low_enough <= peak].max(initial=0)
    high = low_enough[low_enough >= peak].min(initial=smooth.size - 1)
    half = max(0.5 * float(high - low - 1), 0.5) * data.step_hz
    height = max(float(smooth[peak]), float(np.min(model[start:stop])))
    return Candidate(
        frequency_hz=float(data.frequency_hz[start + peak]),
        half_width_hz=half,
        variance_nm2=np.pi * half * height,
        evidence=evidence,
    )


def _moving_mean(series: FloatArray, width: int) -> FloatArray:
    """Return the mean over a width around each value, (n,), with zeros beyond the ends."""
    total = np.cumsum(np.append(0.0, series))
    last = np.arange(series.size) + (width - 1) // 2 + 1
    first = np.maximum(last - width, 0)
    return np.asarray((total[np.minimum(last, series.size)] - total[first]) / width)
