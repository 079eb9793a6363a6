"""The check of a record: whether its commands reach its measurements as given.

The control law says which repairs make it one that somebody runs, and the likelihood of the
repaired commands decides: by a coarse spectrum, and by the model of the fit where the law does not
ask for the repair. A factor of two in the size of commands is left to the gains of the fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError, RecordError
from lbt_synth.identification.commands.coarse_spectrum import (
    CLEAR,
    MOST_SHIFT_FRAMES,
    SEGMENT_S,
    CoarseRecord,
)
from lbt_synth.identification.commands.control_law import (
    FOLLOWED,
    SHORT_ORDER,
    ControlLaw,
    classify_matrix,
    fit_control_law,
    law_controller,
)
from lbt_synth.identification.commands.repair import (
    CommandRepair,
    repair_commands,
)
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS, TYPICAL_GAIN, Search, cost
from lbt_synth.identification.fit.order_search import FEW_ROUNDS, find_components
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.records.faults import SURPRISING
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.storage.rows import Facts, fact, facts
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, FloatArray, frozen_copy, require_instance

AS_GIVEN = "as given"
_FIND = "find the commands that belong to these measurements"
_GIVEN = CommandRepair()
_ODD = CLEAR / 2  # nats that what no law asks for must add, by the model of the fit as well
_SURPRISING = 3 * CLEAR  # nats that overrule a law with errors
_WRONG_GAIN = 2.0  # factor by which a coarse gain may err; another unit is off by its square
_ANOTHER_UNIT = 25.0  # factor beyond the limits that no wide resonances explain
_FACTORS = (*(10.0**n for n in range(-12, 13) if n), 0.5, 2.0)  # between units, or of reflection
_LITTLE = 0.01  # of the gain of a law, which has no inverse; or of the changes of commands, which
# moves a gain by 10 % if the law leaves them
_LINES = 10  # at most, of a fit that tells delays apart: more of them take minutes
_HIDDEN = 1e-7  # distance of poles at two gains that are the same
_ANY = np.geomspace(1.0, 1e-6, 19)  # gains of a loop that may be of no sensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandVerdict:
    """How the commands of a record reach its measurements."""

    explanation: str  # the best one, in words; "as given" if that is what was given
    repair: CommandRepair = _GIVEN  # without options where nothing is wrong or nothing helps
    delay_frames: float | None = None  # delay that fits, where another was given
    # log-likelihood above that of the record as given; 0 where the law alone decides
    nats: float = 0.0
    gain: FloatArray  # (axes,), coarse sensor gain; nan where the coarse spectrum does not show it
    law: ControlLaw | None  # None where too few frames show it
    notes: tuple[str, ...] = ()  # what to look at although the record is accepted

    @property
    def accepted(self) -> bool:
        """Whether a model may be fitted."""
        return self.explanation == AS_GIVEN

    @property
    def options(self) -> str:
        """The options of the command line that repair the record; empty if there are none."""
        delay = "" if self.delay_frames is None else f"--delay-frames {self.delay_frames:g}"
        return f"{self.repair.options} {delay}".strip()

    @property
    def doubt(self) -> str:
        """What is wrong with the commands, without advice; empty if nothing is."""
        return "" if self.accepted else self.explanation.partition(". ")[0]

    @property
    def advice(self) -> str:
        """What to do about it; empty if nothing is wrong."""
        if self.accepted:
            return ""
        if self.options:
            return f"read the record with {self.options}"
        advice = self.explanation.partition(". ")[2]
        return advice[:1].lower() + advice[1:] or _FIND

    @property
    def overruled(self) -> tuple[str, ...]:
        """What a design assumes that is made although the record is refused."""
        if self.accepted:
            return ()
        return (f"the record is right, although its commands look as if {self.doubt}",)

    def facts(self) -> Facts:
        """Return the verdict as a row of a table."""
        return facts(
            explanation=fact(self.explanation, "the commands"),
            nats=fact(self.nats, "evidence", format=".0f"),
            repair=fact(self.options, "repair"),
        )

    def require_accepted(self) -> None:
        """Refuse a record that something else explains better.

        The message says which law fits, and names all options that repair the record.
        """
        if self.accepted:
            return
        law = "" if self.law is None else f" ({self.law.name} fits them{self.law.lag_text})"
        tried = f"{self.options}, or " if self.options else ""
        raise RecordError(
            f"the commands do not reach the measurements as given: {self.explanation}{law}.",
            explanation=self.explanation,
            options=self.options,
            in_python=f"Repair them as the options {self.options} do." if self.options else "",
            at_terminal=f"Try {tried}--accept-record to go on as it is.",
        )


def explain_commands(
    record: LoopRecord, *, sensor_gain: float | Sequence[float] | None = None
) -> CommandVerdict:
    """Check whether the commands of a closed-loop record reach its measurements as given.

    Each repair of the commands gives another pseudo-open-loop series, and only the right one has
    the simple spectrum of turbulence, lines and noise: Whittle's likelihood on a coarse model
    decides between the commands as given, with other signs, exchanged or shifted, increments, other
    units, and commands that have nothing to do with the measurements. The control law that computed
    the commands says which of these are likely, and tells a shifted record from a wrong delay. A
    known gain of the sensor is one number or one per axis; by default 0.2 to 1.25 is plausible.
    """
    require_instance(record, LoopRecord)
    delay = record.hardware.delay_frames  # refuses a record without one
    if record.commands is None:
        raise ProblemError("the record is of an open loop: it has no commands to explain.")
    known = None if sensor_gain is None else record.known_gains(sensor_gain)
    shown = record_law(record)
    commands = record.commands[record.usable]
    still = np.all(commands == commands[:1], axis=0)
    if still.any() and not still.all():
        return _explain_moving(record, still, shown, known)
    law = None if shown is None or shown.kind == "none" else shown
    refuse = partial(CommandVerdict, gain=np.full(record.axes, np.nan), law=shown)
    sure = law if law is not None and law.is_sure else None
    if sure is not None and (doubt := _doubt_law(sure)):
        return refuse(explanation=doubt)
    lag = 0 if sure is None else sure.lag_frames
    early, lag = max(-lag, 0), max(lag, 0)
    if early:  # corrections that follow from the future have no likelihood: they are moved first
        record = repair_commands(record, CommandRepair(shift_frames=early))
        law = None if sure is None else replace(sure, lag_frames=0)
    coarse = CoarseRecord(record)
    if not coarse.stretches:
        repair = CommandRepair(shift_frames=early)
        note = "the commands were not tested: no stretch of usable frames is long enough"
        shifted = " and ".join(repair.words())
        return refuse(explanation=shifted or AS_GIVEN, repair=repair, notes=(note,))
    usual = PLAUSIBLE_GAINS if known is None else (float(np.min(known)), float(np.max(known)))
    limits = usual[0] / _WRONG_GAIN**2, usual[1] * _WRONG_GAIN**2
    choice = _choose(coarse, law, lag, None if known is None else limits)
    scale = np.ones(record.axes)
    if not choice.unrelated.any():
        scale = _scale(coarse, law, choice, limits)
    is_low = choice.gain < usual[0] / _WRONG_GAIN
    is_hidden = bool(np.any(scale < 1) or (sure is None and np.any(is_low)))
    if doubt := _doubt_choice(record, law, choice, is_hidden):
        return refuse(explanation=doubt)
    off = choice.repair.shift_frames and choice.repair.shift_frames + lag
    shift = early or (-lag if choice.repair.shift_frames else 0)
    repair = replace(choice.repair, shift_frames=shift, scale=tuple(scale))
    words = repair.words()
    if off:
        words.append(f"the total delay is {delay + off:g} frames, not {delay:g}")
    if np.any(scale != 1):
        words.append(wrong_scale(scale, choice.gain))
    gain = choice.gain / scale
    hidden = (gain <= limits[0]) | (gain >= limits[1])
    return refuse(
        explanation=" and ".join(words) or AS_GIVEN,
        repair=repair,
        delay_frames=delay + off if off else None,
        nats=choice.nats,
        gain=frozen_copy(np.where(hidden, np.nan, gain)),
        notes=() if words else _note_law(delay, lag, _unexplained(law)),
    )


def _doubt_choice(
    record: LoopRecord, law: ControlLaw | None, choice: _Choice, is_hidden: bool
) -> str:
    """Return what the best repair leaves wrong, in words; empty if there is nothing."""
    if choice.unrelated.all():
        return "they have nothing to do with the measurements, as if of another night"
    if choice.unrelated.any():
        axis = int(np.argmax(choice.unrelated))
        return f"those of axis {axis} have nothing to do with its measurements"
    ran = law is None or not law.exact or law.order > SHORT_ORDER or choice.repair != _GIVEN
    if not ran and law is not None and not could_have_run(_GIVEN, _ANY, record, law):
        return (
            "a loop with the law that they follow is unstable at any sensor gain. Check what the "
            "series are"
        )
    if is_hidden and (hiding := _unexplained(law)):
        return (
            f"{hiding}, which hides the sensor gain. Record more digits, cut the record, or give "
            "the sensor gain"
        )
    return ""


def _unexplained(law: ControlLaw | None) -> str:
    """Return in words that the commands follow their law in part only; empty if they do."""
    if law is None or law.residual < _LITTLE:
        return ""
    return (
        f"their law leaves {100 * law.residual:.2g} % of their changes unexplained: they are "
        "rounded, disturbed or held, or in part of other frames"
    )


def _note_law(delay_frames: float, lag: int, hiding: str) -> tuple[str, ...]:
    """Return what to look at in an accepted record whose law has a lag, or explains too little."""
    notes = []
    if lag:
        notes.append(
            f"warning: the commands follow measurements {count_text(lag, 'frame')} earlier. If the "
            "real-time computer takes that long, the total delay of a new design is "
            f"{delay_frames + lag:g} frames"
        )
    if hiding:
        notes.append(
            f"warning: of the commands, {hiding}. The sensor gain may be larger than it looks"
        )
    return tuple(notes)


def record_law(record: LoopRecord) -> ControlLaw | None:
    """Return the control law of a closed-loop record; None where the frames are too few."""
    if record.commands is None:
        return None
    with suppress(ProblemError):
        good = record.measured & record.commanded
        return fit_control_law(record.measurements, record.commands, usable=good)
    return None


def _explain_moving(
    record: LoopRecord, still: BoolArray, law: ControlLaw | None, known: FloatArray | None
) -> CommandVerdict:
    """Explain the commands of the axis that moves; the other loop was open."""
    y, u = record.measurements[:, ~still], np.asarray(record.commands)[:, ~still]
    one = replace(record, measurements=y, commands=u)
    verdict = explain_commands(one, sensor_gain=None if known is None else known[~still].tolist())
    gain = np.full(still.size, np.nan)
    gain[~still] = verdict.gain
    note = f"the commands of axis {int(np.argmax(still))} stand still: its loop was open"
    return replace(verdict, gain=frozen_copy(gain), law=law, notes=(*verdict.notes, note))


def _doubt_law(law: ControlLaw) -> str:
    """Return what no repair undoes in a sure law, in words; empty if there is nothing."""
    followed, lags = law.axis_coherence >= FOLLOWED, law.axis_lags
    if np.any(followed) and np.ptp(lags[followed]):  # no real-time computer does that
        late, frames = int(np.argmax(lags)), count_text(int(np.ptp(lags)), "frame")
        return (
            f"those of axis {late} follow their measurements {frames} later than those of axis "
            f"{1 - late}; move one of them"
        )
    largest = np.sum(np.linalg.norm(law.taps, axis=2), axis=1)
    steady = np.sum(law.taps, axis=1) / largest[:, None]
    if law.order <= 1 and np.max(abs(steady)) < _LITTLE:
        return "they follow from the changes of the measurements, as if both had been exchanged"
    if np.all(followed) and np.linalg.cond(steady) > 1 / _LITTLE:
        return "those of both axes follow the same measurements: one axis was recorded twice"
    return ""


def list_repairs(
    axes: int, delay_frames: float, law: ControlLaw | None = None, lag: int = 0
) -> list[CommandRepair]:
    """Return what the commands of a record may need, the first nothing.

    The law may ask for a matrix, and for a long shift. A shift moves corrections to frames that
    still follow from the past of the measurements; it stands for another delay, too.
    """
    signs = [(), (-1,), *((1, -1), (-1, 1))[: 2 * axes - 2]]
    out = [CommandRepair(swap_axes=bool(k), sign=sign) for k in range(axes) for sign in signs]
    short_shifts = range(-MOST_SHIFT_FRAMES, MOST_SHIFT_FRAMES + 1)
    shifts = [k for k in short_shifts if k and k >= 1 - lag - delay_frames]
    shifts += [-lag] if lag > MOST_SHIFT_FRAMES else []
    out += [CommandRepair(shift_frames=k) for k in shifts]
    out.append(CommandRepair(increments=True))
    if law is not None and law.is_sure and law.axes_kind == "general":
        # what undoes the gain of the law: a turn, and all of it
        U, s, Vh = np.linalg.svd(law.gain)
        if s[-1] > _LITTLE * s[0]:
            for undone in (np.ones(2), np.sqrt(s[0] * s[1]) / s):
                matrix = (Vh.T * undone) @ U.T
                out.append(CommandRepair(matrix=tuple(matrix.ravel().tolist())))
    return out


class _Choice(NamedTuple):
    """The best repair of the commands."""

    repair: CommandRepair
    gain: FloatArray  # (axes,), of the sensor with it
    nats: float  # by which it is likelier than the record as given
    unrelated: BoolArray  # (axes,), of commands that follow no law and do not reach the axis


def _choose(
    coarse: CoarseRecord, law: ControlLaw | None, lag: int, known: tuple[float, float] | None
) -> _Choice:
    """Return the repair that law and likelihood ask for.

    Where limits of a known gain hold as given, they have to hold after a repair.
    """
    record = coarse.record
    repairs = list_repairs(record.axes, record.hardware.delay_frames, law, lag)
    contrasts, gain = coarse.compare(repairs)
    contrasts, unrelated = contrasts[:, :-1], contrasts[:, -1]
    contrast = contrasts.sum(axis=0)
    penalty, asked = _penalties(repairs, gain, record, law, lag)
    if known is not None:
        held = gain[:, : penalty.size]
        holds = np.all((held > known[0]) & (held < known[1]), axis=0)
        penalty = np.where(holds | (not holds[0]), penalty, np.inf)
    best = int(np.argmin(contrast + penalty))
    nats = contrast[0] - contrast
    if asked[best]:
        is_shown = penalty[0] >= _SURPRISING or nats[best] >= _ODD
    else:
        is_shown = (
            nats[best] >= CLEAR
            and _fit_cost(coarse, _GIVEN) - _fit_cost(coarse, repairs[best]) >= _ODD
        )
    best = best if is_shown else 0
    followed = np.zeros(record.axes) if law is None else law.axis_coherence
    return _Choice(
        repairs[best],
        gain[:, best],
        max(float(nats[best]), 0.0),
        (followed < FOLLOWED) & (unrelated - np.min(contrasts, axis=1) < CLEAR),
    )


def _penalties(
    repairs: Sequence[CommandRepair],
    gains: FloatArray,
    record: LoopRecord,
    law: ControlLaw | None,
    lag: int,
) -> tuple[FloatArray, BoolArray]:
    """Return the nats that repairs (n,) cost because of the laws they make, and which the law asks.

    A loop that would have been unstable has not run. A law that is not exact overrules no clear
    likelihood.
    """
    odd = np.array([_is_unusual(repair, law, lag) for repair in repairs])
    impossible = np.zeros(len(repairs), dtype=np.bool_)
    if law is not None and law.is_sure:
        for i, repair in enumerate(repairs):
            impossible[i] = not could_have_run(
                repair, [gains[:, i], TYPICAL_GAIN, *PLAUSIBLE_GAINS], record, law
            )
        impossible &= not impossible.all()
    odd |= impossible
    asked = ~odd & odd[0]
    refuted = np.array(odd if asked.any() else impossible)
    # a slow computer has a lag, and a matrix may couple axes on purpose: the sensor tells
    is_plausible = np.all(np.clip(gains[:, 0], *PLAUSIBLE_GAINS) == gains[:, 0])
    if is_plausible and law is not None and law.order > 0:
        refuted[0] = False
    surprise = np.inf if law is not None and law.exact else _SURPRISING
    return np.where(refuted, surprise, _ODD * odd), asked


def _is_unusual(repair: CommandRepair, law: ControlLaw | None, lag: int) -> bool:
    """Return whether a repair makes the control law one that no one would run."""
    shift = repair.shift_frames
    if law is None:
        return shift != 0
    if shift:
        return shift != -lag or lag == 0
    if (repair == _GIVEN and lag) or repair.increments == law.adds_up:
        return True
    kind, signs = classify_matrix(repair.turn(len(law.gain)) @ law.gain)
    if kind == "swapped" or min(signs) < 0:
        return True
    # a long law may couple the axes, as a filter of lines along diagonals does
    return kind != "diagonal" and law.order <= SHORT_ORDER


def could_have_run(
    repair: CommandRepair, gains: Iterable[FloatArray | float], record: LoopRecord, law: ControlLaw
) -> bool:
    """Return whether the recorded law would have been stable at any gain, of all or each axis."""
    if repair.increments:
        return True  # another law computes the positions
    controller = law_controller(law, record.frame_rate_hz)
    path = replace(
        record.hardware,
        delay_frames=max(record.hardware.delay_frames + repair.shift_frames, 1.0),
        influence_matrix=repair.turn(record.axes),
    )
    one = np.ones(record.axes)
    paths = (replace(path, sensor_matrix=np.diag(gain * one)) for gain in gains)
    return any(_moving_radius(path, controller) < 1 for path in paths)


def _moving_radius(path: LoopHardware, controller: Controller) -> float:
    """Return the largest modulus of the poles of a loop that depend on its sensor gain.

    A law that was found from series has poles and zeros that cancel, outside of the circle too.
    Infinite where the gain is so small that nothing depends on it: that loop was open.
    """
    weaker = replace(path, sensor_matrix=0.8 * path.sensor)
    poles, others = (
        np.linalg.eigvals(close_loop(loop, controller).system.A) for loop in (path, weaker)
    )
    moves = np.min(abs(poles[:, None] - others), axis=1) > _HIDDEN
    return float(np.max(abs(poles[moves]))) if moves.any() else np.inf


def _fit_cost(coarse: CoarseRecord, repair: CommandRepair, gain: float | None = None) -> float:
    """Return the criterion of a quick fit over all axes, at a gain; infinite where one fails."""
    record, total = coarse.record, 0.0
    length = int(SEGMENT_S * record.frame_rate_hz)
    pieces = [
        (start, min(start + length, b))
        for a, b in coarse.stretches
        for start in range(a, max(b - length, a) + 1, length)
    ]
    for y, c in zip(record.measurements.T, coarse.corrections(repair).T, strict=True):
        data = loop_periodogram(y, c, frame_rate_hz=record.frame_rate_hz, stretches=pieces)
        search = Search(data=data, gain=gain, most_lines=_LINES, gain_error=float("inf"))
        try:
            total += cost(search, find_components(search, rounds=FEW_ROUNDS))
        except NumericalError:
            return np.inf
    return total


def _scale(
    coarse: CoarseRecord, law: ControlLaw | None, choice: _Choice, limits: tuple[float, float]
) -> FloatArray:
    """Return the factors (axes,) of commands whose gains lie beyond the limits of another unit.

    A sure law that runs at a plausible gain refutes commands that are too large: a gain that seems
    too small is one that lines hide. One that seems too large by less than a hundred may be that of
    wide resonances, unless quick fits of plausible gains are clearly less likely.
    """
    low, high = limits
    record, seeming = coarse.record, float(np.exp(np.mean(np.log(choice.gain))))
    within = (choice.gain >= low) & (choice.gain <= high)
    if seeming < low and law is not None and law.is_sure:
        usual = np.geomspace(*PLAUSIBLE_GAINS, 8)
        within |= could_have_run(choice.repair, usual, record, law)
    if high < seeming < _ANOTHER_UNIT * high:
        tried = np.geomspace(low * _WRONG_GAIN**2, high / _WRONG_GAIN**2, 3).tolist()
        held = [_fit_cost(coarse, choice.repair, gain) for gain in (*tried, seeming)]
        within |= min(held[:-1]) < held[-1] + CLEAR
    return likely_factors(choice.gain, within)


def likely_factors(gains: FloatArray, within: BoolArray) -> FloatArray:
    """Return the likeliest factors of commands whose sensor gains (axes,) are not within limits.

    They are those between units, or the 2 of a reflection, and one for all where no gain is within.
    """
    means = gains if within.any() else np.exp(np.mean(np.log(gains))) * np.ones(gains.size)
    away = np.abs(np.log(means[:, None] / np.array(_FACTORS) / TYPICAL_GAIN))
    return np.where(within, 1.0, np.array(_FACTORS)[np.argmin(away, axis=1)])


def judge_fitted_gains(gains: FloatArray, errors: FloatArray) -> CommandVerdict:
    """Judge the commands by the sensor gains (axes,) of a fit, with their standard errors.

    The fit shows gains beyond the plausible ones where the coarse model leaves them open.
    """
    accepted = not np.all(gains - SURPRISING * errors > PLAUSIBLE_GAINS[1])
    scale = likely_factors(gains, np.full(gains.size, accepted))
    return CommandVerdict(
        explanation=AS_GIVEN if accepted else wrong_scale(scale, gains),
        repair=CommandRepair(scale=tuple(scale)),
        gain=frozen_copy(gains / scale),
        law=None,
    )


def wrong_scale(scale: FloatArray, gain: FloatArray) -> str:
    """Return the words for commands that need a factor on each axis, (axes,)."""
    one = not np.ptp(scale)
    words = [
        f"{'they' if one else f'those of axis {axis}'} are "
        f"{max(factor, 1 / factor):g} times too {'large' if factor < 1 else 'small'}"
        for axis, factor in enumerate(scale.tolist())
        if factor != 1
    ]
    gains = ", ".join(f"{value:.3g}" for value in gain)
    text = " and ".join(words[:1] if one else words)
    return f"{text} (with them the sensor has a gain of {gains})"
