"""Commands that are recorded in steps so coarse that these change the sensor gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.validation import BoolArray, FloatArray, read_only

_FUZZ = 1e-6  # of the range of values, within which two are the same
_MATTERS = 1e-6  # of the variance of increments, that the rounding must have
_SEEN, _DROWNED = 1.03, 1.15  # factors of a gain that get a note, and that are too large


def command_steps(commands: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the step in which the commands of each axis are recorded, (axes,); 0 if none shows."""
    return np.array([_step(np.unique(column)) for column in commands[usable].T])


def _step(values: FloatArray) -> float:
    """Return the step of which sorted values are multiples, but for an offset."""
    gaps = np.diff(values)
    gaps = gaps[gaps > _FUZZ * np.ptp(values)] if gaps.size else gaps
    if not gaps.size:
        return 0.0
    step = float(np.min(gaps))
    away = (values - values[0]) / step
    return step if np.max(np.abs(away - np.round(away))) < 0.1 else 0.0


def is_stepped(record: LoopRecord) -> bool:
    """Return whether commands are recorded in steps that may change the sensor gain."""
    return bool(np.any(_matters(record)))


def _matters(record: LoopRecord) -> BoolArray:
    """Return the axes whose rounding may matter, (axes,)."""
    assert record.commands is not None
    steps = command_steps(record.commands, record.usable)
    changes = np.var(np.diff(record.commands, axis=0), axis=0)
    return np.asarray(steps**2 / 12 > _MATTERS * changes)


def gain_dilution(coarse: CoarseRecord) -> FloatArray:
    """Return by how much sensor gains are too small for the steps of commands, (axes,), about.

    What rounding takes from a gain, as much rounding again takes once more (J. R. Cook, L. A.
    Stefanski, J. Am. Stat. Assoc. 89, 1314 (1994), doi:10.2307/2290994).
    """
    record, steps = coarse.record, _steps(coarse)
    assert record.commands is not None
    matters = _matters(record)
    if not np.any(matters):
        return np.ones(record.axes)
    rounding = np.random.default_rng(0).uniform(-0.5, 0.5, record.commands.shape) * steps
    worse = CoarseRecord(replace(record, commands=read_only(record.commands + rounding)))
    given = [Guess(kind="as given")]
    own, moved = coarse.compare(given).gain[:, 0], worse.compare(given).gain[:, 0]
    return np.where(matters, np.maximum(own / moved, 1.0), 1.0)


def doubt_steps(coarse: CoarseRecord, dilution: FloatArray) -> str | None:
    """Return that a sensor gain drowns in the steps of the recorded commands, in words."""
    worst = int(np.argmax(dilution))
    if dilution[worst] < _DROWNED:
        return None
    return drowns_in_steps(coarse, worst)


def drowns_in_steps(coarse: CoarseRecord, axis: int) -> str:
    """Return the words for a sensor gain that steps hide."""
    step = _steps(coarse)[axis]
    return (
        f"those of axis {axis} are recorded in steps of {step:.3g} nm, in which the sensor gain "
        "drowns. Record more digits, or give the sensor gain"
    )


def note_steps(coarse: CoarseRecord, dilution: FloatArray) -> tuple[str, ...]:
    """Return by how much the steps of the recorded commands may lower the sensor gain."""
    if np.max(dilution) < _SEEN:
        return ()
    step = _steps(coarse)[int(np.argmax(dilution))]
    return (
        f"warning: the commands are recorded in steps of {step:.3g} nm: the true sensor gain may "
        f"be {np.max(dilution):.2g} times the one that is found. Record more digits",
    )


def _steps(coarse: CoarseRecord) -> FloatArray:
    assert coarse.record.commands is not None
    return command_steps(coarse.record.commands, coarse.record.usable)
