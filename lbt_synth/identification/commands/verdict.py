"""The check of a record: whether its commands reach its measurements as given.

The control law says which repairs make it one that somebody runs, and the likelihood of the
repaired commands decides: by a coarse spectrum, and by the model of the fit where the law does not
ask for the repair. A factor of two in the size of commands is left to the gains of the fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError, RecordError
from lbt_synth.identification.commands.coarse_spectrum import (
    CLEAR,
    MOST_SHIFT_FRAMES,
    SEGMENT_S,
    coarse_stretches,
    compare_repairs,
    repaired_corrections,
)
from lbt_synth.identification.commands.control_law import (
    FOLLOWED,
    SHORT_ORDER,
    ControlLaw,
    classify_matrix,
    fit_control_law,
    law_controller,
)
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands
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

    explanation: str = AS_GIVEN  # the best one, in words
    repair: CommandRepair = _GIVEN  # without options where nothing is wrong or nothing helps
    gain: FloatArray  # (axes,), coarse sensor gain; nan where the coarse spectrum does not show it
    law: ControlLaw | None  # None where too few frames show it
    notes: tuple[str, ...] = ()  # what to look at although the record is accepted
    read_with: str = ""  # options with which the record was read

    @property
    def accepted(self) -> bool:
        """Whether a model may be fitted."""
        return self.explanation == AS_GIVEN

    @property
    def doubt(self) -> str:
        """What is wrong with the commands, without advice; empty if nothing is."""
        return "" if self.accepted else self.explanation.partition(". ")[0]

    @property
    def advice(self) -> str:
        """What to do about it; empty if nothing is wrong."""
        if self.accepted:
            return ""
        if self._wrong_options:
            return f"leave {self._wrong_options} out"
        if self.repair.options:
            return f"read the record with {self._options}"
        advice = self.explanation.partition(". ")[2]
        return advice[:1].lower() + advice[1:] or _FIND

    @property
    def _options(self) -> str:
        """The options that repair the record, with those that it was read with."""
        return f"{self.read_with} {self.repair.options}".strip() if self.repair.options else ""

    @property
    def _wrong_options(self) -> str:
        """The options with which the record was read, if one is wrong or another replaces it."""
        asked, read_with = (
            {word for word in options.split() if word.startswith("--")}
            for options in (self.repair.options, self.read_with)
        )
        turns = {"--command-matrix"} if asked & {"--swap-axes", "--command-sign"} else set[str]()
        wrong = {"--command-increments"} | turns | (asked or read_with)
        return self.read_with if wrong & read_with else ""

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
            repair=fact(self.repair.options, "repair"),
        )

    def require_accepted(self) -> None:
        """Refuse a record that something explains better: name the law, and all that repairs it."""
        if self.accepted:
            return
        law = "" if self.law is None else f" ({self.law.name} fits them{self.law.lag_text})"
        options = "" if self._wrong_options else self._options
        try_first = f"Try {options}, or" if options else "Try"
        if self._wrong_options:
            try_first = f"Leave {self._wrong_options} out, or give"
        raise RecordError(
            f"the commands do not reach the measurements as given: {self.explanation}{law}.",
            explanation=self.explanation,
            options=options,
            in_python=f"Repair them as the options {options} do." if options else "",
            at_terminal=f"{try_first} --accept-record to go on as it is.",
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
    _ = record.hardware  # refuses a record without a delay
    if record.commands is None:
        raise ProblemError("the record is of an open loop: it has no commands to explain.")
    known = None if sensor_gain is None else record.known_gains(sensor_gain)
    law, commands = fit_control_law(record), record.commands[record.usable]
    still = np.all(commands == commands[:1], axis=0)
    if still.all() or not still.any():
        return _explain(record, law, known)
    # the loop of the other axis was open
    y, u = record.measurements[:, ~still], record.commands[:, ~still]
    moving = replace(record, measurements=y, commands=u)
    verdict = _explain(moving, fit_control_law(moving), None if known is None else known[~still])
    gain = np.where(still, np.nan, verdict.gain)
    note = f"the commands of axis {int(np.argmax(still))} stand still: its loop was open"
    return replace(verdict, gain=frozen_copy(gain), law=law, notes=(*verdict.notes, note))


def _explain(
    record: LoopRecord, shown: ControlLaw | None, known: FloatArray | None
) -> CommandVerdict:
    """Explain the commands of axes that move, of which the record shows a law."""
    law = None if shown is None or shown.kind == "none" else shown
    unknown = np.full(record.axes, np.nan)
    refuse = partial(CommandVerdict, gain=unknown, law=shown, read_with=record.read_with)
    sure = law if law is not None and law.is_sure else None
    if sure is not None and (doubt := _doubt_law(sure)):
        return refuse(explanation=doubt)
    lag = 0 if sure is None else sure.lag_frames
    if sure is not None and lag < 0:
        # corrections that follow from the future have no likelihood: they are moved first
        moved = CommandRepair(shift_frames=-lag)
        verdict = _explain(repair_commands(record, moved), replace(sure, lag_frames=0), known)
        words = [*moved.words(), *([] if verdict.accepted else [verdict.explanation])]
        repair = replace(verdict.repair, shift_frames=-lag)
        return replace(verdict, explanation=" and ".join(words), repair=repair, law=shown)
    if not coarse_stretches(record):
        note = "the commands were not tested: no stretch of usable frames is long enough"
        return refuse(notes=(note,))
    usual = PLAUSIBLE_GAINS if known is None else (float(np.min(known)), float(np.max(known)))
    limits = usual[0] / _WRONG_GAIN**2, usual[1] * _WRONG_GAIN**2
    repair, gain, unrelated, delays = _choose(record, law, lag, None if known is None else limits)
    scale = np.ones(record.axes)
    if not unrelated.any():
        scale = _scale(record, law, repair, gain, limits)
    is_low = sure is None and np.any(gain < usual[0] / _WRONG_GAIN)
    if doubt := _doubt_repair(record, law, repair, unrelated, bool(is_low or np.any(scale < 1))):
        return refuse(explanation=doubt)
    delay_frames = record.hardware.delay_frames
    off = repair.shift_frames and repair.shift_frames + lag
    delays_off = _likely_delays(record, delay_frames + off, lag) if off else []
    repair = replace(
        repair,
        shift_frames=-lag if repair.shift_frames else 0,
        delay_frames=delays_off[0] if delays_off else None,
        scale=_factors(scale),
    )
    large = gain / scale >= limits[1]
    notes = _note_law(delay_frames, lag, delays, _unexplained(law), gain[large])
    return refuse(
        explanation=_name_repair(repair, gain, delays_off[1:]),
        repair=repair,
        gain=frozen_copy(np.where((gain / scale <= limits[0]) | large, np.nan, gain / scale)),
        notes=() if repair.options else notes,
    )


def _likely_delays(record: LoopRecord, delay_frames: float, lag: int) -> list[float]:
    """Return the total delays near one that a fit of the model leaves open, the likeliest first."""
    moved, near = CommandRepair(shift_frames=-lag), delay_frames + np.arange(-1.0, 1.5, 0.5)
    costs = {d: _fit_cost(record.with_delay(d), moved) for d in near[near >= 1].tolist()}
    likely = [d for d, value in costs.items() if value <= min(costs.values()) + _ODD]
    return sorted(likely, key=costs.__getitem__)


def _name_repair(repair: CommandRepair, gain: FloatArray, delays: Sequence[float] = ()) -> str:
    """Return what a repair undoes, with the gains (axes,) of its scale and other likely delays."""
    if not repair.options:
        return AS_GIVEN
    gains = ", ".join(f"{value:.3g}" for value in gain)
    shown = f" (with them the sensor has a gain of {gains})" if repair.scale else ""
    others = " or ".join(f"{delay:g}" for delay in delays)
    rival = [f"a delay of {others} frames explains the record as well"] if delays else []
    return " and ".join([*repair.words(), *rival]) + shown


def _doubt_repair(
    record: LoopRecord,
    law: ControlLaw | None,
    repair: CommandRepair,
    unrelated: BoolArray,
    is_hidden: bool,
) -> str:
    """Return what the best repair leaves wrong, in words; empty if there is nothing."""
    if unrelated.all():
        return "they have nothing to do with the measurements, as if of another night"
    if unrelated.any():
        axis = int(np.argmax(unrelated))
        return f"those of axis {axis} have nothing to do with its measurements"
    is_as_given = repair == _GIVEN and law is not None and law.exact and law.order <= SHORT_ORDER
    if is_as_given and not could_have_run(repair, _ANY, record, law):
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


def _note_law(
    delay_frames: float, lag: int, delays: Sequence[float], hiding: str, large: FloatArray
) -> tuple[str, ...]:
    """Return what to look at in an accepted record: its lag, delay, law, and too large gains."""
    late = (
        f"warning: the commands follow measurements {count_text(lag, 'frame')} earlier. If the "
        "real-time computer takes that long, the total delay of a new design is "
        f"{delay_frames + lag:g} frames"
    )
    few = f"warning: of the commands, {hiding}. The sensor gain may be larger than it looks"
    others = " or ".join(f"{delay:g}" for delay in delays)
    several = (
        f"warning: the record leaves the total delay open: {others} explain it as well as the "
        f"{delay_frames:g} frames that are given and taken"
    )
    gains = " and ".join(f"{gain:.2g}" for gain in large)
    small = (
        f"warning: the sensor gain looks like {gains}, as if the commands were too small, and the "
        "record does not tell. Check their unit (--command-scale), or raise the loop gain"
    )
    notes = {late: lag, several: delays, few: hiding, small: gains}
    return tuple(note for note, holds in notes.items() if holds)


def _doubt_law(law: ControlLaw) -> str:
    """Return what no repair undoes in a sure law, in words; empty if there is nothing."""
    followed, lags = law.axis_coherence >= FOLLOWED, law.axis_lags
    if np.any(followed) and np.ptp(lags[followed]):  # no real-time computer does that
        late, frames = int(np.argmax(lags)), count_text(int(np.ptp(lags)), "frame")
        return (
            f"those of axis {late} follow their measurements {frames} later than those of axis "
            f"{1 - late}; move one of them"
        )
    largest = np.sum(np.linalg.norm(law.taps, axis=2), axis=1)[:, None]
    steady = np.sum(law.taps, axis=1) / largest
    if law.order <= 1 and np.max(abs(steady)) < _LITTLE:
        return "they follow from the changes of the measurements, as if both had been exchanged"
    # of all lags: those of a long law add up to nearly nothing
    weights = (law.taps / largest[:, None]).reshape(-1, len(law.taps))
    if np.all(followed) and np.linalg.cond(weights) > 1 / _LITTLE:
        return "those of both axes follow the same measurements: one axis was recorded twice"
    return ""


def list_repairs(
    axes: int, delay_frames: float, law: ControlLaw | None = None, lag: int = 0
) -> list[CommandRepair]:
    """Return what commands may need, first nothing; corrections follow from the past after all."""
    signs = [(), (-1,), *((1, -1), (-1, 1))[: 2 * axes - 2]]
    out = [CommandRepair(swap_axes=bool(k), sign=sign) for k in range(axes) for sign in signs]
    short_shifts = range(-MOST_SHIFT_FRAMES, MOST_SHIFT_FRAMES + 1)
    shifts = [k for k in short_shifts if k and k >= 1 - lag - delay_frames]
    shifts += [-lag] if lag > MOST_SHIFT_FRAMES else []
    out += [CommandRepair(shift_frames=k) for k in shifts]
    out.append(CommandRepair(increments=True))
    if law is not None and law.is_sure and law.axes_kind == "general":
        U, _, Vh = np.linalg.svd(law.gain)  # what undoes the turn in the gain of the law
        out.append(CommandRepair(matrix=tuple((U @ Vh).T.ravel().tolist())))
    return out


def _choose(
    record: LoopRecord, law: ControlLaw | None, lag: int, known: tuple[float, float] | None
) -> tuple[CommandRepair, FloatArray, BoolArray, list[float]]:
    """Return the likeliest repair, its gain, which axes are unrelated, and other likely delays."""
    fit_cost, delay_frames = cache(partial(_fit_cost, record)), record.hardware.delay_frames
    repairs = list_repairs(record.axes, delay_frames, law, lag)
    contrasts, gains = compare_repairs(record, repairs)
    contrasts, unrelated = contrasts[:, :-1], contrasts[:, -1]
    contrast = contrasts.sum(axis=0)
    penalty, asked = _penalties(repairs, gains, record, law, lag)
    if known is not None:
        held = gains[:, : penalty.size]
        holds = np.all((held > known[0]) & (held < known[1]), axis=0)
        penalty = np.where(holds | (not holds[0]), penalty, np.inf)
    best = int(np.argmin(contrast + penalty))
    nats = contrast[0] - contrast[best]
    if asked[best]:
        is_shown = penalty[0] >= _SURPRISING or nats >= _ODD
    else:
        is_shown = nats >= CLEAR and fit_cost(_GIVEN) - fit_cost(repairs[best]) >= _ODD
    best = best if is_shown else 0
    delays = [
        delay_frames + frames
        for frames in (-1, 1)
        for i, repair in enumerate(repairs)
        if best == 0 and repair == CommandRepair(shift_frames=frames) and lag == 0
        if contrast[i] - contrast[0] < CLEAR and fit_cost(repair) - fit_cost(_GIVEN) < _ODD
    ]
    followed = np.zeros(record.axes) if law is None else law.axis_coherence
    reaches_not = (followed < FOLLOWED) & (unrelated - np.min(contrasts, axis=1) < CLEAR)
    return repairs[best], gains[:, best], reaches_not, delays


def _penalties(
    repairs: Sequence[CommandRepair],
    gains: FloatArray,
    record: LoopRecord,
    law: ControlLaw | None,
    lag: int,
) -> tuple[FloatArray, BoolArray]:
    """Return the nats that repairs (n,) cost by the laws they make, and which the law asks for."""
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
    repair: CommandRepair,
    gains: Iterable[FloatArray | float],
    record: LoopRecord,
    law: ControlLaw | None,
) -> bool:
    """Return whether the recorded law would have been stable at any gain, of all or each axis."""
    if repair.increments or law is None:
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
    """Return the largest modulus of the poles that depend on the sensor gain, infinite of none."""
    # a law that was found from series has poles and zeros that cancel, outside of the circle too
    weaker = replace(path, sensor_matrix=0.8 * path.sensor)
    poles, others = (
        np.linalg.eigvals(close_loop(loop, controller).system.A) for loop in (path, weaker)
    )
    moves = np.min(abs(poles[:, None] - others), axis=1) > _HIDDEN
    return float(np.max(abs(poles[moves]))) if moves.any() else np.inf


def _fit_cost(record: LoopRecord, repair: CommandRepair, gain: float | None = None) -> float:
    """Return the criterion of a quick fit over all axes, at a gain; infinite where one fails."""
    total, length = 0.0, int(SEGMENT_S * record.frame_rate_hz)
    pieces = [
        (start, min(start + length, b))
        for a, b in coarse_stretches(record)
        for start in range(a, max(b - length, a) + 1, length)
    ]
    corrections = repaired_corrections(record, repair) @ repair.turn(record.axes).T
    for y, c in zip(record.measurements.T, corrections.T, strict=True):
        data = loop_periodogram(y, c, frame_rate_hz=record.frame_rate_hz, stretches=pieces)
        search = Search(data=data, gain=gain, most_lines=_LINES, gain_error=float("inf"))
        try:
            total += cost(search, find_components(search, rounds=FEW_ROUNDS))
        except NumericalError:
            return np.inf
    return total


def _scale(
    record: LoopRecord,
    law: ControlLaw | None,
    repair: CommandRepair,
    gain: FloatArray,
    limits: tuple[float, float],
) -> FloatArray:
    """Return the factors (axes,) of commands whose gains lie beyond the limits of another unit."""
    low, high = limits
    seeming = float(np.exp(np.mean(np.log(gain))))
    within = (gain >= low) & (gain <= high)
    if np.any(gain < low) and law is not None and law.is_sure:  # lines hide a gain at which it runs
        usual = np.geomspace(*PLAUSIBLE_GAINS, 8)
        within |= could_have_run(repair, usual, record, law)
    if high < seeming < _ANOTHER_UNIT * high:  # wide resonances look like that
        tried = np.geomspace(low * _WRONG_GAIN**2, high / _WRONG_GAIN**2, 3).tolist()
        held = [_fit_cost(record, repair, guess) for guess in (*tried, seeming)]
        within |= min(held[:-1]) < held[-1] + CLEAR
    return likely_factors(gain, within)


def likely_factors(gains: FloatArray, within: BoolArray) -> FloatArray:
    """Return the factors between units or of a reflection, one for all where no gain is within."""
    means = gains if within.any() else np.exp(np.mean(np.log(gains))) * np.ones(gains.size)
    away = np.abs(np.log(means[:, None] / np.array(_FACTORS) / TYPICAL_GAIN))
    return np.where(within, 1.0, np.array(_FACTORS)[np.argmin(away, axis=1)])


def _factors(scale: FloatArray) -> tuple[float, ...]:
    """Return the factors of a repair: none, one for all axes, or one for each."""
    return () if np.all(scale == 1) else tuple(scale[: 1 if np.ptp(scale) == 0 else None].tolist())


def judge_fitted_gains(gains: FloatArray, errors: FloatArray) -> CommandVerdict:
    """Judge the commands by the sensor gains (axes,) of a fit, with their standard errors."""
    accepted = not np.all(gains - SURPRISING * errors > PLAUSIBLE_GAINS[1])
    scale = likely_factors(gains, np.full(gains.size, accepted))
    repair = CommandRepair(scale=_factors(scale))
    return CommandVerdict(
        explanation=_name_repair(repair, gains),
        repair=repair,
        gain=frozen_copy(gains / scale),
        law=None,
    )
