"""Jumps, where a series goes on elsewhere: no spectrum has them, and records are cut there."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np

from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT, half_angle_square, tukey
from lbt_synth.identification.stretches import Stretches
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, IntArray

_LARGE = 12.0  # standard deviations of the change of a correction
_UNLIKELY = 8.0  # standard deviations of the innovations
_EDGE = 0.06  # of a stretch, at either end, where the taper hides jumps
_AROUND = 3  # frames left out on either side
_SAME_JUMP = 50  # frames within which outliers, and the axes, have one jump
_MOST_JUMPS = 20  # at which a record is cut


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
    for place in np.split(far, 1 + np.flatnonzero(np.diff(far) > _SAME_JUMP)):
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
