"""What no stationary spectrum has: sinusoids that drift, and jumps, where series go on elsewhere.

Sinusoids that drift are what a fit takes for narrow lines, measured along the drifting phase.

The likelihood compares every line with a stationary process. A sinusoid whose frequency rises
evenly through many bins has a spectrum with edges, which no resonance has, and the fit puts one
or more lines of far too large skirts in its place. In a band around such lines the series is::

    a(t) = A e^(i pi (2 f t + r t^2)) + rest

A and f follow from the transform of ``a(t) e^(-i pi r t^2)``, and r is where that has its highest
peak. It is sought near the rate at which the frequency between neighbouring samples rises.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from lbt_synth.identification.fit.identified_model import (
    IdentifiedAxis,
    IdentifiedLine,
    IdentifiedModel,
)
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    TAPER,
    half_angle_square,
    tukey,
)
from lbt_synth.identification.stretches import Stretches
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.words import count_text
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

_REACH_HZ = 3.0  # of the band on either side, and between lines that may be one
_FEWEST_BINS = 16  # of a band
_NARROW = 3.0  # bins: a line of a larger half width is no sinusoid, one that drifts less stands
_LEAST_SHARE = 0.5  # of the power in the band that the sinusoid must have, beside 1 / bins
_MOST_DAMPING = 0.05
_LEAST_ERROR = 0.05  # of the rms: an even drift is an approximation
_LINES = ("a line stands", "several lines stand")
_RATES = 257  # tried at first
_FINE = np.arange(-4, 4.01, 0.25)  # bins by which the drift over the record is corrected
_PADDED = 4
_LARGE = 12.0  # standard deviations of the change of a correction
_UNLIKELY = 8.0  # standard deviations of the innovations
_EDGE = 0.06  # of a stretch, at either end, where the taper hides jumps
_CLUSTER = 20  # frames within which outliers are one jump
_AROUND = 3  # frames left out on either side
_SAME_JUMP = 50  # frames within which the axes have one jump
_MOST_JUMPS = 20  # at which a record is cut


@dataclass(frozen=True, slots=True, kw_only=True)
class LineDrift:
    """A sinusoid whose frequency rises or falls evenly."""

    frequency_hz: float  # in the middle of the record
    rate_hz_s: float
    duration_s: float
    rms_nm: float
    share: float  # of the power in its band

    @property
    def range_hz(self) -> float:
        """How far the frequency moves."""
        return abs(self.rate_hz_s) * self.duration_s

    @property
    def is_clear(self) -> bool:
        """Whether a resonance that only wanders hardly looks like it."""
        bins = self.range_hz * self.duration_s
        return bins > _NARROW and self.share > _LEAST_SHARE + 1 / bins

    def covers(self, line: IdentifiedLine) -> bool:
        """Whether a line lies where the sinusoid has been."""
        reach = self.range_hz / 2 + _NARROW / self.duration_s
        return abs(line.frequency_hz - self.frequency_hz) < reach

    def correct(self, lines: Sequence[IdentifiedLine]) -> list[IdentifiedLine]:
        """Return lines that have the power of the sinusoid together, and errors that cover.

        Each keeps its skirts, the power with which a filter for the line follows the drift.
        """
        scale = self.rms_nm / float(np.sqrt(sum(line.rms_nm**2 for line in lines)))
        unexplained = float(np.hypot(1 / np.sqrt(self.share) - 1, _LEAST_ERROR))
        return [
            replace(
                line,
                frequency_error_hz=self.range_hz / float(np.sqrt(12)),
                damping=min(line.damping / scale**2, _MOST_DAMPING),
                damping_error=min(line.damping / scale**2, _MOST_DAMPING),
                resolved=True,
                rms_nm=scale * line.rms_nm,
                rms_error_nm=scale * line.rms_nm * unexplained,
            )
            for line in lines
        ]


def describe_drifts(
    model: IdentifiedModel, series: FloatArray, stretches: Stretches
) -> IdentifiedModel:
    """Return a model whose lines have the power of the sinusoids that drift, with notes on these.

    They are sought in the longest stretch of the pseudo-open-loop series (frames, axes).
    """
    start, stop = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    axes, notes = [], list(model.notes)
    for i, (axis, own) in enumerate(zip(model.axes, series[start:stop].T, strict=True)):
        parts = list(axis.parts)
        for drift in _axis_drifts(axis, own):
            covered = [part for part in _narrow_parts(axis, drift.duration_s) if drift.covers(part)]
            for old, new in zip(covered, drift.correct(covered), strict=True):
                parts[parts.index(old)] = new
            notes.append(
                f"warning: axis {i} has a sinusoid of {nm_text(drift.rms_nm)} that drifts by "
                f"{drift.rate_hz_s:.2g} Hz/s, {drift.range_hz:.2g} Hz in {drift.duration_s:.3g} s "
                f"around {drift.frequency_hz:.4g} Hz; {_LINES[len(covered) > 1]} for it"
            )
        axes.append(replace(axis, parts=tuple(parts)))
    shared = tuple(_correct_shared(line, axes) for line in model.shared)
    return replace(model, axes=tuple(axes), shared=shared, notes=tuple(notes))


def _correct_shared(line: IdentifiedLine, axes: Sequence[IdentifiedAxis]) -> IdentifiedLine:
    """Return a line of both axes with the power that the axes have of it."""
    shares = [p for axis in axes for p in axis.parts if p.frequency_hz == line.frequency_hz]
    strongest = max(shares, key=lambda share: share.rms_nm)
    if strongest.damping == line.damping:
        return line
    rms = float(np.sqrt(sum(share.rms_nm**2 for share in shares)))
    return replace(
        line,
        frequency_error_hz=strongest.frequency_error_hz,
        damping=strongest.damping,
        damping_error=strongest.damping_error,
        resolved=True,
        rms_nm=rms,
        rms_error_nm=rms * strongest.rms_error_nm / strongest.rms_nm,
    )


def _narrow_parts(axis: IdentifiedAxis, duration_s: float) -> list[IdentifiedLine]:
    """Return the parts of an axis that may stand for sinusoids, by frequency."""
    return [
        part
        for part in axis.parts
        if part.kind != "turbulence" and part.damping * part.frequency_hz * duration_s < _NARROW
    ]


def _axis_drifts(axis: IdentifiedAxis, series: FloatArray) -> list[LineDrift]:
    """Return the sinusoids that drift in a series (n,), in place of narrow lines."""
    rate = axis.frame_rate_hz
    narrow = _narrow_parts(axis, series.size / rate)
    groups: list[list[float]] = []
    for part in narrow:
        if groups and part.frequency_hz - groups[-1][-1] < _REACH_HZ:
            groups[-1].append(part.frequency_hz)
        else:
            groups.append([part.frequency_hz])
    bands = [(max(g[0] - _REACH_HZ, g[0] / 2), min(g[-1] + _REACH_HZ, 0.49 * rate)) for g in groups]
    found = [measure_drift(series, rate, band) for band in bands]
    return [
        drift
        for drift in found
        if drift is not None and drift.is_clear and any(drift.covers(part) for part in narrow)
    ]


def measure_drift(
    series: FloatArray, frame_rate_hz: float, band_hz: tuple[float, float]
) -> LineDrift | None:
    """Fit a sinusoid of evenly rising frequency to a band of a series (n,)."""
    n = series.size - 1
    first, last = (round(edge * n / frame_rate_hz) for edge in band_hz)
    count = last - first
    if count < _FEWEST_BINS:
        return None
    power = half_angle_square(np.arange(first, last) * frame_rate_hz / n, frame_rate_hz)
    spectrum = np.fft.rfft(tukey(n) * np.diff(series))[first:last] / np.sqrt(power)
    edge = int(np.ceil(TAPER / 2 * count))  # where the taper is not 1
    wave = np.fft.ifft(spectrum)[edge : count - edge] * (2 * count / n)
    size, step = wave.size, n / frame_rate_hz / count
    t = step * (np.arange(size) - 0.5 * (size - 1))
    turn = wave[1:] * wave[:-1].conj()  # its phase rises as the frequency does
    coarse = np.linspace(-1, 1, _RATES) / (step * size * step)  # Hz/s: through the whole band
    middle = 0.5 * (t[1:] + t[:-1])
    sums = np.abs(np.exp(-2j * np.pi * step * np.outer(coarse, middle)) @ turn)
    rates = coarse[np.argmax(sums)] + _FINE / (step * size) ** 2
    peaks = [_highest_peak(wave * np.exp(-1j * np.pi * rate * t**2)) for rate in rates]
    place, height = max(peaks, key=lambda peak: peak[1])
    best = int(np.argmax([height for _, height in peaks]))
    return LineDrift(
        frequency_hz=first * frame_rate_hz / n + place / step,
        rate_hz_s=float(rates[best]),
        duration_s=n / frame_rate_hz,
        rms_nm=height / float(np.sqrt(2)),
        share=float(height**2 / np.mean(np.abs(wave) ** 2)),
    )


def _highest_peak(wave: ComplexArray) -> tuple[float, float]:
    """Return place (turns per sample, 0 to 1) and amplitude of the highest peak of a transform."""
    size = _PADDED * wave.size
    moduli = np.abs(np.fft.fft(wave, size))
    peak = int(np.argmax(moduli))
    return peak / size, float(moduli[peak]) / wave.size


Jump = tuple[int, float]  # frame where a series goes on elsewhere, standard deviations of that


def find_jumps(
    series: FloatArray, axes: Sequence[IdentifiedAxis], stretches: Stretches
) -> list[Jump]:
    """Find where the innovations of pseudo-open-loop series (frames, axes) are far too large."""
    each = zip(series.T, axes, strict=True)
    return _merge_jumps([jump for one, axis in each for jump in _axis_jumps(one, axis, stretches)])


def _axis_jumps(series: FloatArray, axis: IdentifiedAxis, stretches: Stretches) -> list[Jump]:
    """Find the jumps of one axis, in differences over the root of the fitted spectrum."""
    out: list[Jump] = []
    log_f, log_density = np.log(axis.frequency_hz), np.log(axis.fitted_nm2_hz)
    for start, stop in stretches:
        count = stop - start - 1
        if count < SHORTEST_SEGMENT:
            continue
        transform = np.fft.rfft(tukey(count) * np.diff(series[start:stop]))
        f: FloatArray = np.arange(1.0, transform.size) * (axis.frame_rate_hz / count)
        density = np.exp(np.interp(np.log(f), log_f, log_density))
        power = density * half_angle_square(f, axis.frame_rate_hz) * axis.frame_rate_hz / 2
        transform[0] = 0
        transform[1:] /= np.sqrt(power)
        size = np.abs(np.fft.irfft(transform, count))
        edge = int(_EDGE * count)
        scale = float(np.median(size)) / 0.6745
        far = edge + np.flatnonzero(size[edge : count - edge] > _UNLIKELY * scale)
        out += _largest_of_clusters(size / scale, far, start)
    return out


def find_correction_jumps(corrections: FloatArray, stretches: Stretches) -> list[Jump]:
    """Find where the corrections (frames, axes) go on elsewhere.

    A fit would choose a sensor gain at which a jump of the commands does not show: they are
    looked for before anything is fitted.
    """
    inside = np.zeros(len(corrections) - 1, dtype=np.bool_)
    for start, stop in stretches:
        inside[start : stop - 1] = True
    out: list[Jump] = []
    for change in np.abs(np.diff(corrections, axis=0)).T:
        scale = float(np.median(change[inside])) / 0.6745 if inside.any() else 0.0
        if scale > 0:
            far = np.flatnonzero(inside & (change > _LARGE * scale))
            out += _largest_of_clusters(change / scale, far, 0)
    return _merge_jumps(out)


def _largest_of_clusters(size: FloatArray, far: IntArray, start: int) -> list[Jump]:
    """Return the largest of each cluster of differences that are too large."""
    out = []
    for place in np.split(far, 1 + np.flatnonzero(np.diff(far) > _CLUSTER)):
        if place.size:
            best = int(place[np.argmax(size[place])])
            out.append((start + 1 + best, float(size[best])))
    return out


def _merge_jumps(found: Sequence[Jump]) -> list[Jump]:
    """Return jumps by rising frame, each place once."""
    out: list[Jump] = []
    for jump in sorted(found, key=lambda jump: jump[0]):
        if not out or jump[0] - out[-1][0] > _SAME_JUMP:
            out.append(jump)
    return out


def cut_at_jumps(
    stretches: Stretches, jumps: Sequence[Jump], series: str
) -> tuple[Stretches, list[str]]:
    """Return stretches without the neighbourhood of the jumps of some series, and a note.

    Nothing is cut if there are too many jumps.
    """
    if not jumps:
        return stretches, []
    frame, size = max(jumps, key=lambda jump: jump[1])
    note = (
        f"warning: {count_text(len(jumps), 'jump')} of the {series}, the largest "
        f"at frame {frame} with {size:.0f} standard deviations"
    )
    if len(jumps) > _MOST_JUMPS:
        return stretches, [f"{note}; too many to cut the record there, and the model suffers"]
    cut = cut_around(stretches, [frame for frame, _ in jumps])
    return cut, [f"{note}; the record was cut there"]


def cut_around(stretches: Stretches, frames: Sequence[int]) -> Stretches:
    """Return stretches without the neighbourhood of some frames."""
    for frame in frames:
        low, high = frame - _AROUND, frame + _AROUND
        pieces = chain(*(((a, min(b, low)), (max(a, high), b)) for a, b in stretches))
        stretches = tuple((a, b) for a, b in pieces if b > a)
    return stretches
