"""Bands of frequencies around the lines of a model, and how channels follow the lines there.

Stretches of a record are transformed as for the fit. The expected spectrum of a line is that of its
tapered series, so lines narrower than the resolution keep their power. From the wavefront, the
model's lines and its background, each line's motion is estimated as by a Wiener filter.

Given the wavefront, the readings of a channel are normal with the mean ``expected F`` and the
variance ``noise + F* unseen F``: what the wavefront leaves open of the lines moves the channel,
too. The factors F are found with these weights, in turn with the noise, whose median is robust
against lines of the channel's own. An error of a sensor gain moves all factors in one direction;
it has its own part in their errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import IdentifiedLine, IdentifiedModel
from lbt_synth.identification.fit.periodogram import LoopPeriodogram, segment_transforms
from lbt_synth.identification.fit.whittle import component_density
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray

NM = 1e-9
_HALF_WIDTHS = 20.0  # of a line, from its centre to the edge of its band
_CORE_HALF_WIDTHS = 5.0
_BINS = 40.0
_CORE_BINS = 2.0
_PART = 0.25  # of the frequency of a line, to which its band reaches at most
_STEPS = 30
_INDEPENDENT = 0.94  # of the values of a tapered transform
_DOUBT = 0.01  # chance below which a channel moves at a line more than its noise explains
_FLOOR = 1e-9  # of a channel's power


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineBand:
    """A band around one line, or around lines whose bands overlap."""

    lines: tuple[int, ...]  # indices of its lines among all
    angle: FloatArray  # (f,) [rad per frame]
    readings: ComplexArray  # (f, channels) [m/s^2 per sqrt(Hz)]
    expected: ComplexArray  # (f, all lines): of a motion of 1 nm per nm [m/s^2 per sqrt(Hz)]
    moved: ComplexArray  # (f, all lines, axes): change of it for a standard error of each gain
    unseen: FloatArray  # (f, all lines, all lines): covariance that the wavefront leaves of it
    core: BoolArray  # (f, lines): frequencies of the lines themselves


def line_bands(
    model: IdentifiedModel,
    lines: Sequence[IdentifiedLine],
    wavefront: FloatArray,
    moved: FloatArray,
    readings: FloatArray,
    stretches: Sequence[tuple[int, int]],
) -> list[LineBand]:
    """Return the bands of all lines, wavefront (frames, axes) and readings (frames, channels).

    ``moved`` (frames, axes) is the change of the wavefront for a standard error of its sensor gain.
    """
    rate, axes = model.frame_rate_hz, wavefront.shape[1]
    length = max(stop - start for start, stop in stretches)
    kept = [each for each in stretches if each[1] - each[0] >= length / 4]
    series = np.hstack([wavefront, moved, readings])
    parts = [_transform(series[start:stop], lines, rate) for start, stop in kept]
    frequency, values, shapes = (np.concatenate(each) for each in zip(*parts, strict=True))
    z, step, a = np.split(values, [axes, 2 * axes], axis=1)
    out = []
    resolution = rate / length
    for group, low, high in _groups(lines, resolution):
        inside = np.flatnonzero((frequency >= low) & (frequency <= high))
        f = frequency[inside]
        own = [lines[j] for j in group]
        gain, unseen = _wiener(model, lines, shapes[inside], f)
        # the mean acceleration over a frame, of the mean position in it
        swing = -NM * (2 * np.pi * f) ** 2
        reach = [_reach(line, resolution, _CORE_HALF_WIDTHS, _CORE_BINS) for line in own]
        centres = np.array([line.frequency_hz for line in own])
        out.append(
            LineBand(
                lines=tuple(group),
                angle=2 * np.pi * f / rate,
                readings=a[inside],
                expected=swing[:, None] * np.einsum("fja,fa->fj", gain, z[inside]),
                moved=swing[:, None, None] * gain * step[inside, None],
                unseen=swing[:, None, None] ** 2 * unseen,
                core=np.abs(f[:, None] - centres) <= reach,
            )
        )
    return out


def _transform(
    series: FloatArray, lines: Sequence[IdentifiedLine], rate: float
) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """Return frequencies (f,), tapered transforms (f, series), and densities of lines (f, lines).

    The squares of the transforms are densities.
    """
    rows = np.arange(len(series))[None]
    frequency, values, _ = segment_transforms(series, rows, rate, levelled=True)
    zero = np.zeros_like(frequency)
    data = LoopPeriodogram(
        frequency_hz=frequency,
        measured=zero,
        crossed=zero,
        corrected=zero,
        count=zero,
        frame_rate_hz=rate,
        resolution_hz=rate / len(series),
        duration_s=(len(series) - 1) / rate,
    )
    search = Search(data=data)
    each = [
        search.component("line", line.frequency_hz, line.damping, line.rms_nm**2) for line in lines
    ]
    shapes = [component_density(data, component) for component in each]
    return frequency, values[:, 0].T, np.stack(shapes, axis=1)


def _reach(line: IdentifiedLine, resolution: float, widths: float, bins: float) -> float:
    half_width = line.damping * line.frequency_hz
    return float(min(max(widths * half_width, bins * resolution), _PART * line.frequency_hz))


def _groups(
    lines: Sequence[IdentifiedLine], resolution: float
) -> list[tuple[list[int], float, float]]:
    """Return the lines of each band with its edges [Hz]; bands that overlap are one."""
    out: list[tuple[list[int], float, float]] = []
    for j in sorted(range(len(lines)), key=lambda j: lines[j].frequency_hz):
        reach = _reach(lines[j], resolution, _HALF_WIDTHS, _BINS)
        low, high = lines[j].frequency_hz - reach, lines[j].frequency_hz + reach
        if out and low <= out[-1][2]:
            group, first, last = out.pop()
            out.append(([*group, j], min(first, low), max(last, high)))
        else:
            out.append(([j], low, high))
    return out


def _wiener(
    model: IdentifiedModel,
    lines: Sequence[IdentifiedLine],
    shapes: FloatArray,
    frequency: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the gain that estimates each line, (f, lines, axes), and its error's covariance."""
    axes = len(model.axes)
    along = np.array([(line.direction or (1.0,))[:axes] for line in lines])  # (lines, axes)
    background = [np.interp(frequency, a.frequency_hz, a.background_nm2_hz) for a in model.axes]
    total = np.einsum("fj,ja,jb->fab", shapes, along, along)
    total += np.stack(background, axis=1)[:, :, None] * np.eye(axes)
    cross = shapes[:, :, None] * along  # (f, lines, axes)
    gain = np.linalg.solve(total, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
    unseen = shapes[:, :, None] * np.eye(len(lines)) - np.einsum("fja,fka->fjk", gain, cross)
    return gain, unseen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BandFit:
    """Factors of one channel for the lines of a band."""

    readings: ComplexArray  # (f,): without the lines of other bands
    factors: ComplexArray  # (lines,)
    variances: FloatArray  # (lines,): of the complex factors, for the gains of the model
    slopes: ComplexArray  # (lines, axes): of the factors, for a standard error of each sensor gain
    chances: FloatArray  # (lines,): that a channel without a line would show as much
    coherences: FloatArray  # (lines,)
    noise: FloatArray  # (lines,): density near each line [(m/s^2)^2/Hz]
    weights: FloatArray  # (f,): inverse variances

    def errors(self, j: int) -> tuple[float, float]:
        """Return the standard errors of a factor along itself, and across: of size and phase."""
        turned = self.slopes[j] * np.exp(-1j * np.angle(self.factors[j]))
        scatter = self.variances[j] / 2
        along, across = (np.sqrt(scatter + np.sum(part**2)) for part in (turned.real, turned.imag))
        return float(along), float(across)


def fit_band(band: LineBand, channel: int, others: ComplexArray) -> BandFit:
    """Fit the factors of a channel for the lines of a band, given those of all other lines."""
    own, whole = list(band.lines), others.copy()
    whole[own] = 0
    a, x = band.readings[:, channel] - band.expected @ whole, band.expected[:, own]
    factors = whole[own]
    power = float(np.mean(np.abs(a) ** 2))
    noise, open_part = power, np.zeros(len(a))
    for _ in range(_STEPS):
        level = np.median(np.abs(a - x @ factors) ** 2 / (noise + open_part)) / np.log(2)
        noise = max(noise * float(level), _FLOOR * power)
        weights = 1 / (noise + open_part)
        info = x.conj().T @ (weights[:, None] * x)
        factors = np.asarray(
            np.linalg.lstsq(info, x.conj().T @ (weights * a))[0], dtype=np.complex128
        )
        whole[own] = factors
        open_part = np.einsum("j,fjk,k->f", whole.conj(), band.unseen, whole).real
    inverse = np.linalg.pinv(info)
    variances = np.diag(inverse).real / _INDEPENDENT
    change = np.einsum("fja,j->fa", band.moved, whole)
    slopes = np.asarray(-inverse @ (x.conj().T @ (weights[:, None] * change)))
    return _judge(band, a, factors, variances, slopes, noise, weights)


def _judge(
    band: LineBand,
    a: ComplexArray,
    factors: ComplexArray,
    variances: FloatArray,
    slopes: ComplexArray,
    noise: float,
    weights: FloatArray,
) -> BandFit:
    """Test each line, with larger errors where the channel moves in its own way there."""
    from scipy.special import gammaincc

    x, lines = band.expected[:, list(band.lines)], len(factors)
    error = a - x @ factors
    variances, own = variances.copy(), np.full(lines, noise)
    chances, coherences = np.ones(lines), np.zeros(lines)
    for j in range(lines):
        share = np.abs(x[:, j]) ** 2 * weights
        share = share / max(share.sum(), np.finfo(float).tiny)
        values = max(_INDEPENDENT / float(np.sum(share**2)), 1.0)
        excess = float(share @ (np.abs(error) ** 2 * weights))
        left = max(values - 1, 0.5)
        more, degrees = max(excess * values / left, 1.0), max(_INDEPENDENT * len(a) - lines, 1.0)
        ratio = abs(factors[j]) ** 2 / max(variances[j], np.finfo(float).tiny)
        if gammaincc(left, excess * values) < _DOUBT:
            ratio, degrees = ratio / more, left
            own[j] += max(float(share @ (np.abs(error) ** 2 - 1 / weights)), 0.0)
        variances[j] *= more
        chances[j] = np.exp(-degrees * np.log1p(ratio / degrees))
        core = band.core[:, j]
        alone = error[core] + x[core, j] * factors[j]
        powers = np.sum(np.abs(alone) ** 2) * np.sum(np.abs(x[core, j]) ** 2)
        coherences[j] = abs(np.vdot(x[core, j], alone)) ** 2 / max(powers, np.finfo(float).tiny)
    return BandFit(
        readings=a,
        factors=factors,
        variances=variances,
        slopes=slopes,
        chances=chances,
        coherences=coherences,
        noise=own,
        weights=weights,
    )
