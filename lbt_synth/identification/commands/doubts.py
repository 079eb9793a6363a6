"""What speaks against the commands of a record although no option repairs it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.commands.coarse_spectrum import CLEAR, CoarseRecord, dispersion
from lbt_synth.identification.commands.control_law import FOLLOWED, ControlLaw, fit_control_law
from lbt_synth.identification.commands.repair import CommandRepair
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT, segment_transforms
from lbt_synth.identification.records.faults import equal_runs, mark, runs
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, FloatArray, IntArray, read_only

_SAME_ROWS = 0.05  # sine of the angle between the rows of a gain that are one
_NO_STEADY_GAIN = 1e-3  # of the size of the taps, in their sum
_PARTS = 8  # of a record whose series may slip
_ALIKE = 0.2  # of the largest tap, between laws that are one
_RELATED = 30.0  # nats by which the commands of an axis must be likelier than none
_FUZZ = 1e-6  # of the range of values, within which two are the same
STEPPED = 1e-6  # of the variance of increments, in rounding that may move a gain
_DROWNED = 1.2  # factor by which rounding makes a gain too small to be used
_LEAST_SEGMENTS = 4
_BANDS = 20


def doubt_law(law: ControlLaw) -> str:
    """Return what is wrong with the axes of a sure law, in words; empty if nothing is."""
    followed = law.axis_coherence > FOLLOWED
    lags = law.axis_lags
    if np.any(followed) and np.ptp(lags[followed]):  # no real-time computer does that
        return _axes_apart(lags)
    steady = np.linalg.norm(np.sum(law.taps, axis=1), axis=1)
    largest = np.sum(np.linalg.norm(law.taps, axis=2), axis=1)
    if law.order <= 1 and np.all(steady < _NO_STEADY_GAIN * largest):
        return "they follow from the changes of the measurements, as if both had been exchanged"
    size = np.linalg.norm(law.gain, axis=1, keepdims=True)
    if size.size > 1 and np.all(followed) and np.all(size > 0):
        rows = law.gain / size
        if abs(np.linalg.det(rows)) < _SAME_ROWS:
            return "those of both axes follow the same measurements: one axis was recorded twice"
    return ""


def _axes_apart(lags: IntArray) -> str:
    """Return the words for commands of two axes that follow their measurements differently."""
    late = int(np.argmax(lags))
    frames = int(np.ptp(lags))
    return (
        f"those of axis {late} follow their measurements {count_text(frames, 'frame')} later "
        f"than those of axis {1 - late}; move one of them"
    )


def doubt_parts(record: LoopRecord) -> str:
    """Return that parts of a record have one law at different lags, in words."""
    assert record.commands is not None
    laws = []
    for frames in np.array_split(np.arange(record.frames), _PARTS):
        series = record.measurements[frames], record.commands[frames]
        with suppress(ProblemError):
            law = fit_control_law(*series, usable=record.usable[frames])
            laws += [law] if law.is_sure and np.all(law.axis_coherence > FOLLOWED) else []
    for one, other in pairwise(laws):
        if one.lag_frames == other.lag_frames or one.taps.shape != other.taps.shape:
            continue
        if np.max(np.abs(one.taps - other.taps)) < _ALIKE * np.max(np.abs(one.taps)):
            return (
                f"parts of them follow their measurements at different lags, {one.lag_frames} and "
                f"{other.lag_frames} frames, as if frames of one series were lost. Cut the record"
            )
    return ""


def doubt_axes(coarse: CoarseRecord, law: ControlLaw) -> str:
    """Return which axis has commands that follow no law and do not reach it, in words.

    Commands that stand still are of an open loop.
    """
    alone = (law.axis_coherence < FOLLOWED) & moving_axes(coarse.record)
    if law.kind == "none" or not np.any(alone):
        return ""
    contrast, _, (misfit,) = coarse.compare([CommandRepair()])
    saved = coarse.unrelated() - contrast[:, 0]
    unrelated = np.flatnonzero(alone & (saved < _RELATED * dispersion(misfit)))
    if not unrelated.size:
        return ""
    return f"those of axis {unrelated[0]} have nothing to do with its measurements"


def moving_axes(record: LoopRecord) -> BoolArray:
    """Return the axes whose commands move, (axes,)."""
    assert record.commands is not None
    used: FloatArray = record.commands[record.usable]
    return np.asarray(np.ptp(used, axis=0) > 0) if used.size else np.ones(record.axes, dtype=bool)


def gain_dilution(coarse: CoarseRecord) -> tuple[FloatArray, FloatArray]:
    """Return by how much the steps of commands make sensor gains too small, and steps (axes,) [nm].

    What rounding takes from a gain, as much rounding again takes once more (J. R. Cook, L. A.
    Stefanski, J. Am. Stat. Assoc. 89, 1314 (1994), doi:10.2307/2290994).
    """
    record = coarse.record
    steps, share = command_steps(record)
    matters = share > STEPPED
    if not np.any(matters):
        return np.ones(record.axes), steps
    assert record.commands is not None
    rounding = np.random.default_rng(0).uniform(-0.5, 0.5, record.commands.shape) * steps
    worse = CoarseRecord(replace(record, commands=read_only(record.commands + rounding)))
    own, moved = (each.compare([CommandRepair()])[1][:, 0] for each in (coarse, worse))
    return np.where(matters, np.maximum(own / moved, 1.0), 1.0), steps


def command_steps(record: LoopRecord) -> tuple[FloatArray, FloatArray]:
    """Return the step of which commands are multiples, 0 if none, and the part that rounding has.

    Of each axis (axes,); the part is that of the variance of the increments.
    """
    assert record.commands is not None
    steps = np.zeros(record.axes)
    for axis, column in enumerate(record.commands[record.usable].T):
        values = np.unique(column)
        gaps = np.diff(values)
        gaps = gaps[gaps > _FUZZ * np.ptp(values)] if gaps.size else gaps
        if gaps.size:
            away = (values - values[0]) / np.min(gaps)
            whole = np.max(np.abs(away - np.round(away))) < 0.1
            steps[axis] = np.min(gaps) if whole else 0.0
    changes = np.var(np.diff(record.commands, axis=0), axis=0)
    return steps, np.asarray(steps**2 / 12 / np.maximum(changes, np.finfo(float).tiny))


def doubt_steps(coarse: CoarseRecord) -> str:
    """Return that a sensor gain drowns in the steps of the recorded commands, in words."""
    dilution, steps = gain_dilution(coarse)
    worst = int(np.argmax(dilution))
    if dilution[worst] < _DROWNED:
        return ""
    return (
        f"those of axis {worst} are recorded in steps of {steps[worst]:.3g} nm, in which the "
        "sensor gain drowns. Record more digits, or give the sensor gain"
    )


def held_while_moving(record: LoopRecord) -> str:
    """Say in how many frames the commands stand still while the mirror moved; empty if in none.

    A mirror that stands still leaves the measurements of an open loop, whose spectrum is that of
    the pseudo-open loop in the other frames. If those of the closed loop explain them better, the
    record of the commands stopped, not the mirror.
    """
    assert record.commands is not None
    corrections = past_corrections(record.mirror_taps, record.commands)
    still = np.array([_still(column, record.usable) for column in corrections.T])
    if not np.any(still):
        return ""
    moving = CoarseRecord(replace(record, usable=record.usable & ~np.any(still, axis=0)))
    if not moving.stretches:
        return ""
    gains = moving.compare([CommandRepair()])[1][:, 0]
    nats = 0.0
    for i, y in enumerate(record.measurements.T):
        both = np.column_stack([y, y + gains[i] * corrections[:, i]])
        held, free = _whole_segments(still[i]), _whole_segments(still[i] ^ record.usable)
        if min(len(held), len(free)) < _LEAST_SEGMENTS:
            continue
        seen = _spectra(both[:, :1], held, record.frame_rate_hz)[0]
        if np.all(seen > 0):  # otherwise nothing is measured there
            closed, opened = (
                len(held) * np.sum(np.log(S) + seen / S)
                for S in _spectra(both, free, record.frame_rate_hz)
            )
            nats += opened - closed
    if nats < CLEAR:
        return ""
    share = 100 * float(np.max(np.mean(still, axis=1)))
    return (
        f"they stand still in {share:.0f} % of the frames, where the "
        "measurements are those of a loop that runs. Cut these frames off, or record them again"
    )


def _still(correction: FloatArray, usable: BoolArray) -> BoolArray:
    """Return the frames of long stretches in which a correction does not move."""
    each = equal_runs(correction, usable)
    return mark(each[each[:, 1] - each[:, 0] >= SHORTEST_SEGMENT], len(correction))


def _whole_segments(frames: BoolArray) -> IntArray:
    """Return the frames of each whole segment of stretches, (segments, frames)."""
    starts = [
        first
        for start, stop in runs(frames)
        for first in range(start, stop - SHORTEST_SEGMENT + 1, SHORTEST_SEGMENT)
    ]
    return np.array(starts, dtype=np.int64)[:, None] + np.arange(SHORTEST_SEGMENT)


def _spectra(series: FloatArray, segments: IntArray, rate_hz: float) -> FloatArray:
    """Return the mean power of each series (frames, n) in some bands, (n, bands)."""
    transforms = segment_transforms(series, segments, rate_hz, levelled=True)[1]
    power = np.mean(np.abs(transforms) ** 2, axis=1)
    edges = np.unique(np.geomspace(1, power.shape[1], _BANDS).astype(np.int64)) - 1
    return np.asarray(np.add.reduceat(power, edges, axis=1) / np.diff(edges, append=power.shape[1]))
