"""The verdict on the commands of a record: whether they reach its measurements as given.

The control law says which repairs make it one that somebody runs, and the likelihood of the
repaired commands decides: first by the coarse spectrum, where that is not enough by the model of
the fit. The law alone decides on records that are too short for a spectrum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TypeAlias

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError, RecordError
from lbt_synth.identification.commands.coarse_spectrum import (
    CLEAR,
    SEGMENT_S,
    CoarseFit,
    CoarseRecord,
    dispersion,
)
from lbt_synth.identification.commands.control_law import (
    ControlLaw,
    classify_matrix,
    fit_control_law,
    law_controller,
)
from lbt_synth.identification.commands.doubts import (
    doubt_axes,
    doubt_law,
    doubt_parts,
    doubt_steps,
    held_while_moving,
    moving_axes,
)
from lbt_synth.identification.commands.repair import (
    CommandRepair,
    axes_repair,
    repair_commands,
)
from lbt_synth.identification.fit.fitting import GAINS, PLAUSIBLE_GAINS, Search, cost
from lbt_synth.identification.fit.order_search import FEW_ROUNDS, find_components, try_other_gains
from lbt_synth.identification.fit.periodogram import loop_periodogram
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
_MOST_SHIFT_FRAMES = 3  # by which commands are tried earlier and later
_ALIKE = 0.1  # nats within which repairs are as likely
_CLEAR_FINER = 8.0  # nats that decide by the criterion of the fit
_UNUSUAL = 10.0  # nats that a law asks for which no one would run
_CONTRADICTED = 60.0  # nats by which a repair is likelier than all that a law allows
_GENERAL = 5.0  # nats by which a matrix without a name, or part of a frame, must be likelier
_RELATED = 60.0  # nats by which commands without a law must be likelier than none
_ABSURD = 3e4  # scale of commands without a law that are rather of another night
_NO_UNIT = 1e12  # scale that no two units of a length or an angle have
_NOT_SHOWN = 3.0  # factor beyond plausible gains
_WRONG_GAIN = 2.0  # factor between a given gain and what the record shows
_FIT_ERRORS = 4.0  # of a fitted gain from a plausible one that refute the unit
_WORST_CONDITION = 100.0  # of the gain of a law that is inverted
_FACTORS = (*(10.0**n for n in range(-12, 13) if n), 0.5, 2.0)  # between units, or of reflection
_USUAL_GAIN = 0.7
_COARSE = 1.5  # factor by which a coarse gain may be wrong
_APART = 1.6  # between gains of two axes that have scales of their own
_INSIDE = 8  # gains that are tried of the plausible ones
_HIDDEN = 1e-7  # distance of poles at two gains that are the same
_STABLE = 1 - 1e-9  # spectral radius below which a loop has run
_SHORT_LAW = 3  # order of a law that does not couple axes, and whose loop can be judged
_TRIED = np.array([[0.3], [0.7], [1.0]])  # gains at which a loop may have run
_ALL_GAINS = np.geomspace(1.0, 1e-6, 19)[:, None]  # the same for a loop that may be of no sensor
_NEARER = 0.2  # of the distance of a gain from the plausible ones, in its logarithm
_NEAR = 0.4  # such a distance that a coarse gain may have
_LIKE = 3.0  # factor between a coarse gain and the fitted one of the same record
_LINES = 10  # at most, of the search for lines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandVerdict:
    """How the commands of a record reach its measurements."""

    explanation: str  # the best one, in words; "as given" if that is what was given
    accepted: bool  # whether a model may be fitted
    repair: CommandRepair = _GIVEN  # without options where nothing is wrong or nothing helps
    delay_frames: float | None = None  # delay that fits, where another was given
    # log-likelihood above that of the record as given; 0 where the law alone decides
    nats: float = 0.0
    gain: FloatArray  # (axes,), coarse sensor gain; nan where the coarse spectrum does not show it
    law: ControlLaw | None  # None where too few frames show it
    notes: tuple[str, ...] = ()  # what to look at although the record is accepted

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
    """Compare explanations of how the commands of a closed-loop record reach its measurements.

    Each explanation gives another pseudo-open-loop series, and only the right one has the simple
    spectrum of turbulence, lines and noise: Whittle's likelihood on a coarse model decides between
    the commands as given, with other signs, exchanged or shifted, increments, other units, and
    commands that have nothing to do with the measurements. The control law that computed the
    commands says which of these are likely, and tells a shifted record from a wrong delay. A known
    gain of the sensor is one number or one per axis; by default 0.2 to 1.25 is plausible.
    """
    require_instance(record, LoopRecord)
    delay = record.hardware.delay_frames  # refuses a record without one
    if record.commands is None:
        raise ProblemError("the record is of an open loop: it has no commands to explain.")
    known = None if sensor_gain is None else record.known_gains(sensor_gain)
    law, moves = record_law(record), moving_axes(record)
    if moves.any() and not moves.all():
        return _explain_moving(record, moves, law, known)
    refuse = partial(CommandVerdict, accepted=False, gain=np.full(record.axes, np.nan), law=law)
    sure = law if law is not None and law.is_sure else None
    doubt = held_while_moving(record) or (doubt_parts(record) if sure is None else doubt_law(sure))
    if doubt:
        return refuse(explanation=doubt)
    late = 0 if sure is None else sure.lag_frames
    early, lag = max(-late, 0), max(late, 0)
    if early:  # corrections that follow from the future have no likelihood: they are moved first
        record = repair_commands(record, CommandRepair(shift_frames=early))
        law = None if sure is None else replace(sure, lag_frames=0)
    coarse = CoarseRecord(record)
    if not coarse.stretches:
        return _explain_by_law(refuse, law, early)
    steps = "" if known is not None else doubt_steps(coarse)
    if law is not None and (doubt := doubt_axes(coarse, law)):
        return refuse(explanation=steps or doubt)
    plausible = PLAUSIBLE_GAINS
    if known is not None:
        plausible = float(np.min(known)) / _WRONG_GAIN, float(np.max(known)) * _WRONG_GAIN
    best = _choose(coarse, law, lag)
    scale = np.ones(record.axes) if best is None else _scale(coarse, law, best, plausible)
    absurd = _ABSURD if law is None or law.kind == "none" else _NO_UNIT
    if best is None or np.max(np.abs(np.log(scale))) > np.log(absurd):
        return refuse(
            explanation="they have nothing to do with the measurements, as if of another night",
            gain=np.zeros(record.axes),
        )
    repair, gain, nats, *_ = best
    if repair == _GIVEN and law is not None and (doubt := _doubt_running(record, law, gain)):
        return refuse(explanation=doubt)
    off = repair.shift_frames and repair.shift_frames + lag
    repair = replace(repair, shift_frames=early or (-lag if repair.shift_frames else 0))
    words = repair.words()
    if off:
        words.append(f"the total delay is {delay + off:g} frames, not {delay:g}")
    if np.any(scale != 1):
        words.append(wrong_scale(scale, gain))
    words = words or [steps] * bool(steps)
    shown = gain / scale
    hidden = (shown <= plausible[0] / _NOT_SHOWN) | (shown >= plausible[1] * _NOT_SHOWN)
    return CommandVerdict(
        explanation=" and ".join(words) or AS_GIVEN,
        accepted=not words,
        repair=replace(repair, scale=tuple(scale)),
        delay_frames=delay + off if off else None,
        nats=max(nats, 0.0),
        gain=frozen_copy(np.where(hidden, np.nan, shown)),
        law=law if not early else sure,
        notes=() if words else _note_lag(delay, lag),
    )


def _note_lag(delay_frames: float, lag: int) -> tuple[str, ...]:
    """Return what to look at in an accepted record whose law has a lag."""
    words = (
        f"warning: the commands follow measurements {count_text(lag, 'frame')} earlier. If the "
        "real-time computer takes that long, the total delay of a new design is "
        f"{delay_frames + lag:g} frames"
    )
    return (words,) if lag else ()


def record_law(record: LoopRecord) -> ControlLaw | None:
    """Return the control law of a closed-loop record; None where the frames are too few."""
    assert record.commands is not None
    measured = record.usable if record.measured is None else record.measured
    with suppress(ProblemError):
        return fit_control_law(
            record.measurements, record.commands, usable=measured, commanded=record.commanded
        )
    return None


def _explain_moving(
    record: LoopRecord, moves: BoolArray, law: ControlLaw | None, known: FloatArray | None
) -> CommandVerdict:
    """Explain the commands of the axis that moves; the loop of the other one was open."""
    assert record.commands is not None
    one = replace(
        record, measurements=record.measurements[:, moves], commands=record.commands[:, moves]
    )
    verdict = explain_commands(one, sensor_gain=None if known is None else known[moves].tolist())
    gain = np.full(record.axes, np.nan)
    gain[moves] = verdict.gain
    note = f"the commands of axis {int(np.argmin(moves))} stand still: its loop was open"
    return replace(verdict, gain=frozen_copy(gain), law=law, notes=(*verdict.notes, note))


def _explain_by_law(
    refuse: Callable[..., CommandVerdict], law: ControlLaw | None, early: int
) -> CommandVerdict:
    """Return the verdict on commands whose likelihood no stretch is long enough to tell."""
    repair = CommandRepair(shift_frames=early)
    if law is not None and law.exact:
        swapped = law.axes_kind == "swapped"
        signs = law.signs[::-1] if swapped else law.signs
        repair = axes_repair(swapped, tuple(sign or 1 for sign in signs))
        repair = replace(repair, shift_frames=early, increments=law.order == 0)
    if repair.options:
        words = " and ".join(repair.words())
        return refuse(explanation=f"by their law {words}", repair=repair)
    note = "the commands were not tested: no stretch of usable frames is long enough"
    return refuse(explanation=AS_GIVEN, accepted=True, notes=(note,))


def list_repairs(
    axes: int, delay_frames: float, law: ControlLaw | None = None, lag: int = 0
) -> list[CommandRepair]:
    """Return what the commands of a record may need, the first nothing.

    The law may ask for a matrix, and for a long shift. A shift moves corrections to frames that
    still follow from the past of the measurements; it stands for another delay, too.
    """
    signs = list(product((1, -1), repeat=axes))
    out = [axes_repair(bool(swapped), each) for swapped in range(axes) for each in signs]
    near = range(-_MOST_SHIFT_FRAMES, _MOST_SHIFT_FRAMES + 1)
    shifts = [k for k in near if k and k >= 1 - lag - delay_frames]
    shifts += [-lag] if lag > _MOST_SHIFT_FRAMES else []
    out += [CommandRepair(shift_frames=k) for k in shifts]
    out.append(CommandRepair(increments=True))
    general = law is not None and law.is_sure and law.axes_kind == "general"
    if law is not None and general and np.linalg.cond(law.gain) < _WORST_CONDITION:
        # what undoes the gain of the law: a turn, and all of it
        one, _, other = np.linalg.svd(law.gain)
        inverse = np.linalg.inv(law.gain)
        for whole in ((one @ other).T, inverse / np.sqrt(abs(np.linalg.det(inverse)))):
            out.append(CommandRepair(matrix=tuple(whole.ravel().tolist())))
    return out


# a repair, the sensor gains (axes,) with it, the nats by which it is likelier than the record as
# given, its contrast, and the nats that decide about it
_Choice: TypeAlias = tuple[CommandRepair, FloatArray, float, float, float]


def _choose(coarse: CoarseRecord, law: ControlLaw | None, lag: int) -> _Choice | None:
    """Return the best repair; None where commands do not reach the measurements."""
    record = coarse.record
    assert record.delay_frames is not None
    repairs = list_repairs(record.axes, record.delay_frames, law, lag)
    compared = coarse.compare(repairs)
    contrast, gain, misfit = compared[0].sum(axis=0), compared[1], compared[2]
    score, surprising = _score(repairs, compared, record, law, lag)
    best = int(np.argmax(score <= np.min(score) + _ALIKE))  # the simplest comes first
    # what the law asks for, which the coarse spectrum may miss
    expected = np.flatnonzero(~surprising)
    if surprising[[0, best]].all() and expected.size:
        other = int(expected[np.argmin(score[expected])])
        if _finer_saving(coarse, repairs[other]) >= _CLEAR_FINER:
            best, score[0] = other, np.inf
    clear = CLEAR * dispersion(misfit[best])
    if law is None or law.kind == "none":
        saved = np.sum(coarse.unrelated()) - np.min(contrast)
        if saved < _RELATED * dispersion(misfit[best]):
            return None
    nats = float(contrast[0] - contrast[best])
    if surprising[0] and not surprising[best]:  # the law asks for it
        shown = nats >= clear / 2 or np.isinf(score[0])
    else:
        shown = nats >= clear and _finer_saving(coarse, repairs[best]) >= _CLEAR_FINER
    if not shown:
        best, nats = 0, 0.0
    return repairs[best], gain[:, best], nats, float(contrast[best]), clear


def _score(
    repairs: Sequence[CommandRepair],
    compared: CoarseFit,
    record: LoopRecord,
    law: ControlLaw | None,
    lag: int,
) -> tuple[FloatArray, BoolArray]:
    """Return the contrast of repairs with what their laws cost, and which laws are surprising.

    A loop that would have been unstable has not run. A law that is not exact overrules no clear
    likelihood.
    """
    axis_contrast, gain, misfit = compared
    contrast = axis_contrast.sum(axis=0)
    unusual = np.array([_is_unusual(repair, law, lag) for repair in repairs])
    possible = _possible_repairs(repairs, gain, record, law)
    surprising = unusual | ~possible
    best = int(np.argmin(contrast))
    if law is not None and not law.exact and surprising[best]:
        expected = contrast[:1] if surprising.all() else contrast[~surprising]
        if np.min(expected) - contrast[best] > _CONTRADICTED * dispersion(misfit[best]):
            return _score(repairs, compared, record, None, 0)  # it did not compute the commands
    assert record.delay_frames is not None
    delays = [record.delay_frames + repair.shift_frames for repair in repairs]
    odd = [bool(each.matrix) or delay % 1 > 0 for each, delay in zip(repairs, delays, strict=True)]
    score = contrast + _UNUSUAL * unusual + _GENERAL * np.array([False, *odd[1:]])
    score[~possible] = np.inf
    if surprising[0] and not surprising.all():  # the law says what is wrong
        score[1:][surprising[1:]] = np.inf
        away = abs(np.log(gain / np.clip(gain, *PLAUSIBLE_GAINS))).max(axis=0)
        memoryless = law is not None and law.order == 0  # it would hold nothing
        if np.min(away[~surprising]) < (_NEAR if memoryless else _NEARER * away[0]):
            score[0] = np.inf  # and so does the sensor
    return score, surprising


def _is_unusual(repair: CommandRepair, law: ControlLaw | None, lag: int) -> bool:
    """Return whether a repair makes the control law one that no one would run."""
    shift = repair.shift_frames
    if law is None or law.kind == "none":
        return shift != 0
    if shift:
        return shift != -lag or lag == 0
    if (repair == _GIVEN and lag) or repair.increments == law.adds_up:
        return True
    kind, signs = classify_matrix(repair.turn(len(law.gain)) @ law.gain)
    if kind == "swapped" or min(signs) < 0:
        return True
    # a long law may couple the axes, as a filter of lines along diagonals does
    return kind != "diagonal" and law.order <= _SHORT_LAW


def _possible_repairs(
    repairs: Sequence[CommandRepair],
    gains: FloatArray,
    record: LoopRecord,
    law: ControlLaw | None,
) -> BoolArray:
    """Return which repairs make loops that have run; all where no law tells."""
    every = np.ones(len(repairs), dtype=np.bool_)
    if law is None or not law.is_sure:
        return every
    tried = _TRIED * np.ones(record.axes)
    possible = np.array(
        [
            could_have_run(repair, np.vstack([gain, 0.3 * gain, *tried]), record, law)
            for repair, gain in zip(repairs, gains.T, strict=True)
        ]
    )
    return possible if possible.any() else every


def could_have_run(
    repair: CommandRepair, gains: FloatArray, record: LoopRecord, law: ControlLaw
) -> bool:
    """Return whether the recorded law would have been stable at any gains (n, axes)."""
    if repair.increments:
        return True  # another law computes the positions
    assert record.delay_frames is not None
    controller = law_controller(law, record.frame_rate_hz)
    path = LoopHardware(
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=max(record.delay_frames + repair.shift_frames, 1.0),
        modes=record.axes,
        influence_matrix=repair.turn(record.axes),
        mirror=record.mirror,
    )
    each = (replace(path, sensor_matrix=np.diag(gain)) for gain in gains)
    return any(_moving_radius(loop, controller) < _STABLE for loop in each)


def _moving_radius(path: LoopHardware, controller: Controller) -> float:
    """Return the largest modulus of the poles of a loop that depend on its sensor gain.

    A law that was found from series has poles and zeros that cancel, outside of the circle too.
    Infinite where the gain is so small that nothing depends on it: that loop was open.
    """
    weaker = replace(path, sensor_matrix=0.8 * path.sensor)
    poles, others = (
        np.linalg.eigvals(close_loop(each, controller).system.A) for each in (path, weaker)
    )
    moves = np.min(abs(poles[:, None] - others), axis=1) > _HIDDEN
    return float(np.max(abs(poles[moves]))) if moves.any() else np.inf


def _doubt_running(record: LoopRecord, law: ControlLaw | None, gains: FloatArray) -> str:
    """Return that no loop has run with the law of these commands at any gain, in words.

    ``gains`` (axes,) are the likeliest ones.
    """
    if law is None or not law.exact or law.order > _SHORT_LAW:
        return ""
    tried = np.vstack([gains, 0.3 * gains, 0.1 * gains, *(_ALL_GAINS * np.ones(record.axes))])
    if could_have_run(_GIVEN, tried, record, law):
        return ""
    return (
        "a loop with the law that they follow is unstable at any sensor gain. Check what the "
        "series are"
    )


def _fit(
    coarse: CoarseRecord,
    repair: CommandRepair,
    gain: float | None = None,
    *,
    other_gains: bool = False,
    begin_at: FloatArray | None = None,
) -> tuple[float, FloatArray]:
    """Return the criterion of the fit over all axes, and the gains (axes,), nan where one failed.

    Any gain is looked for from several, or from one for each axis (axes,) where they are given.
    The model has the lines and the wide resonances that it needs, of which the coarse spectrum has
    few.
    """
    record = coarse.record
    length = int(SEGMENT_S * record.frame_rate_hz)
    pieces = [
        (start, min(start + length, b))
        for a, b in coarse.stretches
        for start in range(a, max(b - length, a) + 1, length)
    ]
    total, gains = 0.0, np.full(record.axes, np.nan)
    series = zip(record.measurements.T, coarse.corrections(repair).T, strict=True)
    for i, (y, c) in enumerate(series):
        data = loop_periodogram(y, c, frame_rate_hz=record.frame_rate_hz, stretches=pieces)
        search = Search(data=data, gain=gain, most_lines=_LINES)
        if begin_at is not None:
            search = replace(search, starting_gains=(float(begin_at[i]),))
        try:
            model = find_components(search, None, rounds=FEW_ROUNDS)
            if other_gains:
                model, _ = try_other_gains(search, model)
        except NumericalError:
            total = np.inf
        else:
            total, gains[i] = total + cost(search, model), model.spectrum.gain
    return total, gains


def _finer_saving(coarse: CoarseRecord, repair: CommandRepair) -> float:
    """Return how much likelier a repair is than the record as given, by the model of the fit.

    Before a saving is clear, the record as given is fitted from other gains as well.
    """
    other, _ = _fit(coarse, repair)
    saving = _fit(coarse, _GIVEN)[0] - other
    return saving if saving < _CLEAR_FINER else _fit(coarse, _GIVEN, other_gains=True)[0] - other


def saving_of_gain(
    coarse: CoarseRecord, repair: CommandRepair, plausible: tuple[float, float]
) -> float:
    """Return how much likelier any gain is than plausible ones, by the model of the fit."""
    low, high = plausible
    free, gains = _fit(coarse, repair)
    if np.all((gains >= low) & (gains <= high)):
        return 0.0
    return min(_fit(coarse, repair, gain)[0] for gain in (low, _usual_gain(plausible), high)) - free


def fit_gains(coarse: CoarseRecord, repair: CommandRepair, gains: FloatArray) -> FloatArray:
    """Return the gains (axes,) of a repair by the model of the fit; the coarse ones where it fails.

    Wide resonances that the coarse spectrum lacks move its gains.
    """
    if not np.all((gains > GAINS["above"]) & (gains < GAINS["below"])):
        return gains
    _, fitted = _fit(coarse, repair, begin_at=gains)
    return np.where(np.abs(np.log(fitted / gains)) < np.log(_LIKE), fitted, gains)


def judge_fitted_gains(gains: FloatArray, errors: FloatArray) -> CommandVerdict:
    """Judge the commands by the sensor gains (axes,) of a fit, with their standard errors.

    The fit shows gains beyond the plausible ones where the coarse model leaves them open.
    """
    accepted = not np.all(gains - _FIT_ERRORS * errors > PLAUSIBLE_GAINS[1])
    scale = np.ones(gains.size) if accepted else likely_factors(gains, PLAUSIBLE_GAINS)
    return CommandVerdict(
        explanation=AS_GIVEN if accepted else wrong_scale(scale, gains),
        accepted=accepted,
        repair=CommandRepair(scale=tuple(scale)),
        gain=frozen_copy(gains / scale),
        law=None,
    )


def _scale(
    coarse: CoarseRecord, law: ControlLaw | None, best: _Choice, plausible: tuple[float, float]
) -> FloatArray:
    """Return the factors (axes,) of commands that make implausible gains plausible ones."""
    repair, found, _, contrast, clear = best
    low, high = plausible
    one, inside = np.ones(found.size), np.geomspace(low, high, _INSIDE)
    if np.all((found >= low) & (found <= high)):
        return one
    near = coarse.profile(repair, np.tile(inside, (found.size, 1)))
    if np.sum(np.min(near, axis=1)) - contrast < clear:
        return one
    gains = fit_gains(coarse, repair, found)
    scale = likely_factors(gains, plausible)
    if law is not None and law.is_sure:
        if not could_have_run(repair, inside[:, None] * one, coarse.record, law):
            return scale
        if np.mean(np.log(gains)) < np.log(low):
            return one  # commands that are too large come from a law that is too strong
    return scale if saving_of_gain(coarse, repair, plausible) >= clear else one


def _usual_gain(plausible: tuple[float, float]) -> float:
    """Return the gain that a sensor has most often."""
    return float(np.clip(_USUAL_GAIN, *plausible))


def likely_factors(gains: FloatArray, plausible: tuple[float, float]) -> FloatArray:
    """Return the likeliest factor of the commands of each axis with these gains, (axes,)."""
    low, high = plausible
    usual = _usual_gain(plausible)

    def factor(gain: float) -> float:
        fits = [f for f in _FACTORS if low <= gain / f <= high]
        fits = fits or [f for f in _FACTORS if low / _COARSE <= gain / f <= _COARSE * high]
        if fits:
            return float(min(fits, key=lambda f: abs(np.log(gain / f / usual))))
        return float(f"{gain / usual:.2g}")

    if np.max(gains) < _APART * np.min(gains):
        return np.full(gains.size, factor(float(np.exp(np.mean(np.log(gains))))))
    return np.array([1.0 if low <= gain <= high else factor(gain) for gain in gains.tolist()])


def wrong_scale(scale: FloatArray, gain: FloatArray) -> str:
    """Return the words for commands that need a factor on each axis, (axes,)."""
    sizes = [
        f"{1 / factor:g} times too large" if factor < 1 else f"{factor:g} times too small"
        for factor in scale
    ]
    words = f"they are {sizes[0]}"
    if np.ptp(scale):
        each = zip(sizes, scale, strict=True)
        words = " and ".join(
            f"those of axis {i} are {size}" for i, (size, factor) in enumerate(each) if factor != 1
        )
    gains = ", ".join(f"{value:.3g}" for value in gain)
    return f"{words} (with them the sensor has a gain of {gains})"
