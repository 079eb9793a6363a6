"""What the control law says against the commands of a record, although no option repairs it."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.commands.control_law import FOLLOWED, ControlLaw, fit_control_law
from lbt_synth.identification.commands.explanations import axes_apart
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import could_have_run
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, FloatArray

_SAME_ROWS = 0.05  # sine of the angle between the rows of a gain that are one
_NO_STEADY_GAIN = 1e-3  # of the size of the taps, in their sum
_SHORT = 3  # order of a law whose loop can be judged
_PARTS_OF_GAIN, _TRIED = np.array([1.0, 0.3, 0.1]), np.geomspace(1.0, 1e-6, 19)
_PARTS = 8  # of a record whose series may slip
_ALIKE = 0.2  # of the largest tap
_RELATED = 30.0  # nats by which the commands of an axis must be likelier than none


def doubt_law(law: ControlLaw) -> str | None:
    """Return what is wrong with the axes of a sure law, in words; None if nothing is."""
    followed = law.axis_coherence > FOLLOWED
    lags = law.axis_lags
    if np.any(followed) and np.ptp(lags[followed]):  # no real-time computer does that
        return axes_apart(lags)
    steady = np.linalg.norm(np.sum(law.taps, axis=1), axis=1)
    largest = np.sum(np.linalg.norm(law.taps, axis=2), axis=1)
    if law.order <= 1 and np.all(steady < _NO_STEADY_GAIN * largest):
        return "they follow from the changes of the measurements, as if both had been exchanged"
    size = np.linalg.norm(law.gain, axis=1, keepdims=True)
    if size.size > 1 and np.all(followed) and np.all(size > 0):
        rows = law.gain / size
        if abs(np.linalg.det(rows)) < _SAME_ROWS:
            return "those of both axes follow the same measurements: one axis was recorded twice"
    return None


def doubt_running(record: LoopRecord, law: ControlLaw | None, gains: FloatArray) -> str | None:
    """Return that no loop has run with the law of these commands at any gain, in words.

    ``gains`` (axes,) are the likeliest ones.
    """
    if law is None or not law.exact or law.order > _SHORT:
        return None
    tried = np.vstack([gains * _PARTS_OF_GAIN[:, None], _TRIED[:, None] * np.ones(record.axes)])
    if could_have_run(Guess(kind="as given"), tried, record, law):
        return None
    return (
        "a loop with the law that they follow is unstable at any sensor gain. Check what the "
        "series are"
    )


def find_slip(record: LoopRecord) -> str | None:
    """Return where commands and measurements slip against each other, in words.

    Each part of such a record has the same law at another lag, and the whole has none.
    """
    assert record.commands is not None
    known: list[tuple[int, int, ControlLaw]] = []
    for frames in np.array_split(np.arange(record.frames), _PARTS):
        start, stop = int(frames[0]), int(frames[-1]) + 1
        series = record.measurements[start:stop], record.commands[start:stop]
        with suppress(ProblemError):
            law = fit_control_law(*series, usable=record.usable[start:stop])
            if law.is_whole:
                known.append((start, stop, law))
    for (start, _, one), (_, stop, other) in pairwise(known):
        late = other.lag_frames - one.lag_frames
        if late and _are_alike(one, other):
            by = f"{count_text(abs(late), 'frame')} {'later' if late > 0 else 'earlier'}"
            return (
                f"from somewhere between the frames {start} and {stop} on they follow their "
                f"measurements {by} than before, as if frames of one series were lost. Cut the "
                "record there"
            )
    return None


def _are_alike(one: ControlLaw, other: ControlLaw) -> bool:
    """Return whether two laws are the same but for their lag."""
    if (one.order, one.taps.shape) != (other.order, other.taps.shape):
        return False
    return bool(np.allclose(one.taps, other.taps, rtol=0, atol=_ALIKE * np.max(np.abs(one.taps))))


def doubt_axes(coarse: CoarseRecord, law: ControlLaw) -> str | None:
    """Return which axis has commands that follow no law and do not reach it, in words.

    Commands that stand still are of an open loop.
    """
    alone = (law.axis_coherence < FOLLOWED) & moving_axes(coarse.record)
    if law.kind == "none" or not np.any(alone):
        return None
    given = Guess(kind="as given")
    best = coarse.compare([given])
    nothing = coarse.profile(given, np.zeros((alone.size, 1)))
    saved = (nothing - best.axis_contrast)[:, 0]
    unrelated = np.flatnonzero(alone & (saved < _RELATED * best.dispersion(0)))
    if not unrelated.size:
        return None
    return f"those of axis {unrelated[0]} have nothing to do with its measurements"


def moving_axes(record: LoopRecord) -> BoolArray:
    """Return the axes whose commands move, (axes,)."""
    assert record.commands is not None
    used: FloatArray = record.commands[record.usable]
    return np.asarray(np.ptp(used, axis=0) > 0) if used.size else np.ones(record.axes, dtype=bool)
