"""What no model of a spectrum can say: jumps in the series, and another delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.order_search import Rules, refit_model
from lbt_synth.identification.fit.parameters import FittedModel, Layout
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    LoopPeriodogram,
    half_angle_square,
    loop_periodogram,
)
from lbt_synth.identification.fit.physical_parameters import WIDE_DAMPING
from lbt_synth.identification.fit.taper import tukey
from lbt_synth.identification.fit.whittle import GAIN, NOISE
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import FloatArray, IntArray

_LARGE = 12.0  # standard deviations of the change of a correction
_UNLIKELY = 8.0  # standard deviations of the innovations
_EDGE = 0.06  # of a stretch, at either end, that is not looked at: the taper is there
_CLUSTER = 20  # frames within which outliers are one jump
_AROUND = 3  # frames left out on either side
DELAYS = (-1.0, -0.5, 0.5, 1.0)  # frames by which another delay is tried
_HIGH = 0.6  # of the highest frequency
_CLEARLY = 5.0  # by which the criterion of another delay is better


@dataclass(frozen=True, slots=True, kw_only=True)
class Jump:
    """A place where a series goes on elsewhere."""

    frame: int  # Frame of the largest innovation
    size: float  # Its size in standard deviations


def find_jumps(
    series: FloatArray, axis: IdentifiedAxis, stretches: Sequence[tuple[int, int]]
) -> list[Jump]:
    """Find where the innovations of a pseudo-open-loop series are far too large.

    The differences are divided by the root of the fitted spectrum, without a shift in time. Shapes:
    series (frames,), stretches list of (start, stop).
    """
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


def find_correction_jumps(
    corrections: FloatArray, stretches: Sequence[tuple[int, int]]
) -> list[Jump]:
    """Find where the corrections of an axis go on elsewhere.

    The sensor gain that fits a jump of the commands is one at which it does not show: it is looked
    for before anything is fitted. Shapes: corrections (frames,), stretches list of (start, stop).
    """
    change = np.abs(np.diff(corrections))
    inside = np.zeros(change.size, dtype=np.bool_)
    for start, stop in stretches:
        inside[start : stop - 1] = True
    scale = float(np.median(change[inside])) / 0.6745 if inside.any() else 0.0
    if scale == 0:
        return []
    far = np.flatnonzero(inside & (change > _LARGE * scale))
    return _largest_of_clusters(change / scale, far, 0)


def _largest_of_clusters(size: FloatArray, far: IntArray, start: int) -> list[Jump]:
    """Return the largest of each cluster of differences that are too large."""
    out = []
    for place in np.split(far, 1 + np.flatnonzero(np.diff(far) > _CLUSTER)):
        if place.size:
            best = int(place[np.argmax(size[place])])
            out.append(Jump(frame=start + 1 + best, size=float(size[best])))
    return out


def cut_around(
    stretches: Sequence[tuple[int, int]], frames: Sequence[int]
) -> list[tuple[int, int]]:
    """Return stretches without the neighbourhood of some frames."""
    out = list(stretches)
    for frame in frames:
        low, high = frame - _AROUND, frame + _AROUND
        pieces = [((a, min(b, low)), (max(a, high), b)) for a, b in out]
        out = [(a, b) for pair in pieces for a, b in pair if b > a]
    return out


def _set_noise(model: FittedModel, data: LoopPeriodogram) -> FittedModel:
    """Return the model with the noise that the highest frequencies have."""
    theta = model.theta.copy()
    high = data.frequency_hz > _HIGH * data.frequency_hz[-1]
    density = float(np.median(data.power(float(np.exp(theta[GAIN])))[high]))
    theta[NOISE] = np.log(density * data.frame_rate_hz / 2)
    return replace(model, fitted=replace(model.fitted, parameters=theta))


def better_delay(
    record: LoopRecord, i: int, axis: IdentifiedAxis, stretches: Sequence[tuple[int, int]]
) -> tuple[float, float] | None:
    """Find a delay with which the model is clearly better, or as good without wide resonances.

    A wrong delay looks like wide resonances: they are left out where another delay is tried.
    Shapes: stretches list of (start, stop) -> (delay, gain).
    """
    assert record.delay_frames is not None
    later = [(a + 2, b) for a, b in stretches if b - a > 2 * SHORTEST_SEGMENT]
    if not later:
        return None
    # of the model as it is, with the gain free and without new parts
    rules = Rules(gain=None, lowest_line_hz=0.0, most_lines=0)
    simple = axis.fitted_model.drop_wide(WIDE_DAMPING)
    found: dict[float, float] = {}
    for shift in (0.0, *DELAYS):
        delay = record.delay_frames + shift
        if delay < 1:
            continue
        told = record.with_delay(delay, mirror=record.mirror)
        data = loop_periodogram(
            record.measurements[:, i],
            told.corrections()[:, i],
            frame_rate_hz=record.frame_rate_hz,
            stretches=later,
        )
        again = refit_model(data, rules, _set_noise(simple, data) if shift else axis.fitted_model)
        if again is not None:
            found[delay] = again.fitted.contrast + Layout(data).price * len(again.parts)
    here = found.pop(record.delay_frames, None)
    if here is None or not found:
        return None
    best = min(found, key=lambda delay: found[delay])
    more = here - found[best]
    return (best, more) if more > _CLEARLY else None
