"""Candidates for lines: bands in which a spectrum has more power than a model."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.validation import FloatArray

_WIDEST = 0.3  # of a frequency


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """An excess of power in a band."""

    frequency_hz: float  # where it is highest
    half_width_hz: float  # at half height
    variance_nm2: float  # of a resonance of that height and width
    gain: float  # log-likelihood that a model with the mean of the band would add


def find_candidates(
    data: LoopPeriodogram, power: FloatArray, model: FloatArray, *, least: float, most: int
) -> list[Candidate]:
    """Find the bands with the most significant excess of power over a model.

    Bands of 1, 2, 4, ... bins are tried everywhere, at steps of a quarter of their width. A band of
    n values with the mean ratio R of power to model would gain ``n (R - 1 - log R)``.
    """
    f, step = data.frequency_hz, data.step_hz
    ratio = np.concatenate([[0.0], np.cumsum(power / model)])
    weight = np.concatenate([[0.0], np.cumsum(data.count)])
    found: list[tuple[float, int, int]] = []
    width = 1
    while width * step < _WIDEST * f[-1] and width < f.size:
        starts = np.arange(0, f.size - width + 1, max(1, width // 4))
        centre = f[starts + width // 2]
        starts = starts[width * step <= np.maximum(_WIDEST * centre, 4 * step)]
        if starts.size:
            mean = (ratio[starts + width] - ratio[starts]) / width
            n = weight[starts + width] - weight[starts]
            gain = np.where(mean > 1, n * (mean - 1 - np.log(np.maximum(mean, 1))), 0)
            worthy = np.flatnonzero(gain > least)
            best = worthy[np.argsort(gain[worthy])[::-1][: 8 * most]]
            found += [(float(gain[i]), int(starts[i]), int(starts[i]) + width) for i in best]
        width *= 2
    found.sort(reverse=True)
    out: list[Candidate] = []
    taken: list[tuple[int, int]] = []
    for worth, start, stop in found:
        if len(out) == most:
            break
        reach = max(3, stop - start)
        if any(start < b + reach and stop > a - reach for a, b in taken):
            continue
        taken.append((start, stop))
        out.append(measure_excess(data, power, model, start, stop, worth))
    return out


def measure_excess(
    data: LoopPeriodogram,
    power: FloatArray,
    model: FloatArray,
    start: int,
    stop: int,
    gain: float = 0.0,
) -> Candidate:
    """Measure place, half width and variance of the highest excess between two bins."""
    f, step = data.frequency_hz, data.step_hz
    excess = power[start:stop] - model[start:stop]
    best = -np.inf
    place = half = height = 0.0
    span = 1
    # choose the smoothing at which the peak is highest over its scatter
    while span <= max(1, (stop - start) // 2):
        kernel = np.ones(span) / span
        smooth = np.convolve(excess, kernel, mode="same")
        i = int(np.argmax(smooth))
        # the scatter falls with the root of the span
        score = float(smooth[i]) * np.sqrt(span)
        if score > best:
            best, height, place = score, float(smooth[i]), float(f[start + i])
            above = smooth > 0.5 * height
            low = i - int(np.argmin(above[i::-1])) if not above[: i + 1].all() else 0
            high = i + int(np.argmin(above[i:])) if not above[i:].all() else len(above) - 1
            half = max(0.5 * (high - low - 1) * step, 0.5 * step)
        span *= 2
    height = max(height, float(np.min(model[start:stop])))
    return Candidate(
        frequency_hz=place, half_width_hz=half, variance_nm2=np.pi * half * height, gain=gain
    )


def smooth_background(
    power: FloatArray, frequency_hz: FloatArray, count: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a background without its lines: frequencies, medians over bands, weights, (b,)."""
    from scipy.special import gammaincinv

    low, high = frequency_hz[0], frequency_hz[-1]
    edges = np.searchsorted(frequency_hz, np.geomspace(low, high * (1 + 1e-12), 80))
    edges = np.unique(np.append(edges, frequency_hz.size))
    shape = max(float(np.median(count)), 0.5)
    to_mean = shape / float(gammaincinv(shape, 0.5))
    bands = [(slice(a, b), to_mean if b - a > 2 else 1.0) for a, b in pairwise(edges)]
    rows = [
        (np.mean(frequency_hz[band]), np.median(power[band]) * factor, np.sum(count[band]))
        for band, factor in bands
    ]
    f, d, w = np.array(rows).T
    return f, d, w
