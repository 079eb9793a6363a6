"""The verdict on the commands of a record: whether they reach its measurements as given.

The factor of commands whose sensor gains are implausible, by the coarse model and by the fit.

What turns the commands of a record into those that its mirror followed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lbt_synth.errors import ProblemError, RecordError
from lbt_synth.identification.commands.control_law import ControlLaw, record_control_law
from lbt_synth.identification.commands.doubts import (
    doubt_axes,
    doubt_law,
    doubt_parts,
    doubt_running,
    doubt_steps,
    held_while_moving,
    moving_axes,
)
from lbt_synth.identification.commands.guesses import (
    MOST_SHIFT_FRAMES,
    CoarseRecord,
    Guess,
    list_guesses,
)
from lbt_synth.identification.commands.plausibility import (
    CLEAR,
    could_have_run,
    finer_saving,
    finer_saving_of_gain,
    fit_gains,
    score_guesses,
)
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.storage.words import count_text
from lbt_synth.validation import (
    BoolArray,
    FloatArray,
    frozen_copy,
    integer,
    number,
    read_only,
    real_array,
    require_instance,
    set_fields,
)

AS_GIVEN = "as given"
_CLEAR_FINER = 8.0  # the same by the criterion of the fit
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
_SWAP = np.array([[0.0, 1.0], [1.0, 0.0]])
_MOST_SHIFT = 100


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandVerdict:
    """How the commands of a record reach its measurements."""

    explanation: str  # the best one, in words; "as given" if that is what was given
    accepted: bool  # whether a model may be fitted
    repair: CommandRepair | None = None  # None where nothing is wrong or nothing helps
    delay_frames: float | None = None  # delay that fits, where another was given
    # log-likelihood above that of the record as given; 0 where the law alone decides
    nats: float = 0.0
    gain: FloatArray  # (axes,), coarse sensor gain; nan where the coarse spectrum does not show it
    law: ControlLaw | None  # None where too few frames show it
    notes: tuple[str, ...] = ()  # what to look at although the record is accepted

    @property
    def options(self) -> str:
        """The options of the command line that repair the record; empty if there are none."""
        words = "" if self.repair is None else self.repair.options
        if self.delay_frames is not None:
            words += f" --delay-frames {self.delay_frames:g}"
        return words.strip()

    @property
    def overruled(self) -> tuple[str, ...]:
        """What a design assumes that is made although the record is refused."""
        if self.accepted:
            return ()
        what = self.explanation.partition(". ")[0]  # without advice
        return (f"the record is right, although its commands look as if {what}",)

    def require_accepted(self) -> None:
        """Refuse a record that something else explains better; name the options that repair it."""
        if not self.accepted:
            advice = f" Repair it as the options {self.options} do." if self.options else ""
            raise RecordError(
                f"the commands do not reach the measurements as the record says: "
                f"{self.explanation}.{advice}",
                explanation=self.explanation,
                options=self.options,
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
    plausible = _plausible(known)
    law, nothing = _find_law(record), np.full(record.axes, np.nan)
    moves = moving_axes(record)
    if moves.any() and not moves.all():
        return _explain_moving(record, moves, law, known)
    refuse = partial(CommandVerdict, accepted=False, gain=nothing, law=law)
    if doubt := _doubt_series(record, law):
        return refuse(explanation=doubt)
    lag = law.lag_frames if law is not None and law.is_sure else 0
    early = max(-lag, 0)
    if early:  # corrections that follow from the future have no likelihood: they are moved first
        assert law is not None
        record = repair_commands(record, CommandRepair(shift_frames=early))
        law = replace(law, lag_frames=0)
    coarse = CoarseRecord(record)
    if not coarse.stretches:
        note = "the commands were not tested: no stretch of usable frames is long enough"
        return CommandVerdict(
            explanation=AS_GIVEN, accepted=True, gain=nothing, law=law, notes=(note,)
        )
    steps = doubt_steps(coarse) if sensor_gain is None else None
    if law is not None and (doubt := _doubt_commands(coarse, law, steps)):
        return refuse(explanation=doubt)
    found = _find_best(coarse, law, max(lag, 0))
    one = np.ones(record.axes)
    scale = one if found is None else found.scale(coarse, law, plausible)
    no_law = law is None or law.kind == "none"
    absurd = _ABSURD if no_law else _NO_UNIT
    if found is None or np.max(np.abs(np.log(scale))) > np.log(absurd):
        return refuse(
            explanation="they have nothing to do with the measurements, as if of another night",
            gain=np.zeros(record.axes),
        )
    if found.guess.kind == "as given" and (doubt := doubt_running(record, law, found.gain)):
        return refuse(explanation=doubt)
    late = f"{count_text(early, 'frame')} early, before their measurements"
    words = [f"they are recorded {late}"] if early else []
    repair, other_delay, why = repair_guess(found.guess, delay, max(lag, 0))
    words += why
    if np.any(scale != 1):
        words.append(wrong_scale(scale, found.gain))
    if steps and not words:
        words.append(steps)
    repair = replace(repair, shift_frames=repair.shift_frames or early, scale=tuple(scale))
    return CommandVerdict(
        explanation=" and ".join(words) or AS_GIVEN,
        accepted=not words,
        repair=repair if repair.options else None,
        delay_frames=other_delay,
        nats=max(found.nats, 0.0),
        gain=_shown_gain(found.gain / scale, plausible),
        law=law,
        notes=() if words else _note_lag(delay, lag),
    )


def _plausible(known: FloatArray | None) -> tuple[float, float]:
    """Return the least and the largest gain that a sensor may have."""
    if known is None:
        return PLAUSIBLE_GAINS
    return float(np.min(known)) / _WRONG_GAIN, float(np.max(known)) * _WRONG_GAIN


def _shown_gain(gain: FloatArray, plausible: tuple[float, float]) -> FloatArray:
    """Return gains, nan where the coarse spectrum shows none."""
    low, high = plausible[0] / _NOT_SHOWN, plausible[1] * _NOT_SHOWN
    return frozen_copy(np.where((gain > low) & (gain < high), gain, np.nan))


def _explain_moving(
    record: LoopRecord, moves: BoolArray, law: ControlLaw | None, known: FloatArray | None
) -> CommandVerdict:
    """Explain the commands of the axis that moves; the loop of the other one was open."""
    assert record.commands is not None
    one = replace(
        record, measurements=record.measurements[:, moves], commands=record.commands[:, moves]
    )
    found = explain_commands(one, sensor_gain=None if known is None else known[moves].tolist())
    gain = np.full(record.axes, np.nan)
    gain[moves] = found.gain
    note = f"the commands of axis {int(np.argmin(moves))} stand still: its loop was open"
    return replace(found, gain=frozen_copy(gain), law=law, notes=(*found.notes, note))


def _doubt_series(record: LoopRecord, law: ControlLaw | None) -> str | None:
    """Return what is wrong with the series of a record whatever the sensor sees, in words."""
    if held := held_while_moving(record):
        return held
    return doubt_law(law) if law is not None and law.is_sure else doubt_parts(record)


def _doubt_commands(coarse: CoarseRecord, law: ControlLaw, steps: str | None) -> str | None:
    """Return why commands do not show the sensor gain, in words; ``steps`` say so of theirs."""
    if doubt := doubt_axes(coarse, law):
        return steps or doubt
    return steps if law.is_ordinary else None


def _find_law(record: LoopRecord) -> ControlLaw | None:
    """Return the control law; None where the frames are too few."""
    try:
        return record_control_law(record)
    except ProblemError:
        return None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Best:
    """The best explanation of a record, and what decides about it."""

    guess: Guess
    nats: float  # over the record as given
    contrast: float
    gain: FloatArray  # (axes,)
    clear: float  # nats that decide

    def scale(
        self, coarse: CoarseRecord, law: ControlLaw | None, plausible: tuple[float, float]
    ) -> FloatArray:
        """Return the factors of commands that make implausible gains plausible ones."""
        decides = {"contrast": self.contrast, "clear": self.clear}
        return find_scale(coarse, law, self.guess, self.gain, plausible=plausible, **decides)


def _find_best(coarse: CoarseRecord, law: ControlLaw | None, lag: int) -> _Best | None:
    """Return the best explanation; None where commands do not reach the measurements."""
    record = coarse.record
    guesses = list_guesses(record, earliest_frames=1.0 - lag)
    if lag > MOST_SHIFT_FRAMES:
        guesses.append(Guess(kind="shift", shift_frames=-lag))
    if law is not None and law.is_sure and law.axis_matrix.kind == "general":
        guesses += [Guess(kind="matrix", matrix=each) for each in _unmix_axes(law.gain)]
    compared = coarse.compare(guesses)
    score, surprising = score_guesses(compared, record, law, lag)
    best = int(np.argmin(score))
    # what the law asks for, which the coarse spectrum may miss
    expected = np.flatnonzero(~surprising)
    if surprising[[0, best]].all() and expected.size:
        other = int(expected[np.argmin(score[expected])])
        if finer_saving(coarse, guesses[other], _CLEAR_FINER) >= _CLEAR_FINER:
            best, score[0] = other, np.inf
    clear = CLEAR * compared.dispersion(best)
    no_law = law is None or law.kind == "none"
    saved = coarse.unrelated() - np.min(compared.contrast) if no_law else np.inf
    if saved < _RELATED * compared.dispersion(best):
        return None
    nats = float(compared.contrast[0] - compared.contrast[best])
    if surprising[0] and not surprising[best]:  # the law asks for it
        shown = nats >= clear / 2 or np.isinf(score[0])
    else:
        finer = finer_saving(coarse, guesses[best], _CLEAR_FINER) if nats >= clear else 0.0
        shown = finer >= _CLEAR_FINER
    if not shown:
        best, nats = 0, 0.0
    return _Best(
        guess=guesses[best],
        nats=nats,
        contrast=float(compared.contrast[best]),
        gain=compared.gain[:, best],
        clear=clear,
    )


def _unmix_axes(gain: FloatArray) -> list[FloatArray]:
    """Return matrices of commands that undo a law's gain: a turn, and all of it."""
    if np.linalg.cond(gain) > _WORST_CONDITION:
        return []
    one, _, other = np.linalg.svd(gain)
    inverse = np.linalg.inv(gain)
    return [(one @ other).T, inverse / np.sqrt(abs(np.linalg.det(inverse)))]


def repair_guess(
    guess: Guess, delay_frames: float, lag: int
) -> tuple[CommandRepair, float | None, list[str]]:
    """Return the repair that a guess asks for, the delay if it is another, and the words."""
    if guess.matrix is not None:
        repair, why = _repair_matrix(guess.matrix)
        return repair, None, [why]
    if guess.kind == "increments":
        return CommandRepair(increments=True), None, ["they are increments, not positions"]
    if guess.shift_frames == 0:
        return CommandRepair(), None, []
    words = []
    if lag:
        words = [f"they are recorded {count_text(lag, 'frame')} late"]
    total = delay_frames + guess.shift_frames + lag
    other = total if total != delay_frames else None
    if other is not None:
        words.append(f"the total delay is {other:g} frames, not {delay_frames:g}")
    return CommandRepair(shift_frames=-lag), other, words


def _repair_matrix(matrix: FloatArray) -> tuple[CommandRepair, str]:
    """Return the repair of a matrix from commands to axes of the measurements, and its words."""
    if len(matrix) == 1:
        return CommandRepair(sign=(-1,)), "they have the opposite sign"
    if not np.isin(np.abs(matrix), (0, 1)).all():
        values = tuple(float(f"{value:.6g}") for value in matrix.ravel())
        rows = ", ".join(f"{value:.4g}" for value in values)
        why = f"between them and the axes of the measurements lies a matrix ({rows})"
        return CommandRepair(matrix=values), why
    swapped = bool(matrix[0, 0] == 0)
    one, other = matrix[:, ::-1].diagonal() if swapped else matrix.diagonal()
    signs = int(one), int(other)
    words = ["those of the two axes are exchanged"] if swapped else []
    if signs == (-1, -1):
        words.append("they have the opposite sign")
    elif min(signs) < 0:
        words.append(f"axis {signs.index(-1)} has the opposite sign")
    sign = () if signs == (1, 1) else (-1,) if signs == (-1, -1) else signs
    return CommandRepair(swap_axes=swapped, sign=sign), " and ".join(words)


def _note_lag(delay_frames: float, lag: int) -> tuple[str, ...]:
    """Return what to look at in an accepted record whose law has a lag."""
    if lag <= 0:
        return ()
    return (
        f"warning: the commands follow measurements {count_text(lag, 'frame')} earlier. If "
        "the real-time computer takes that long, the total delay of a new design is "
        f"{delay_frames + lag:g} frames",
    )


def judge_fitted_gains(gains: FloatArray, errors: FloatArray) -> CommandVerdict:
    """Judge the commands by the sensor gains (axes,) of a fit, with their standard errors.

    The fit shows gains beyond the plausible ones where the coarse model leaves them open.
    """
    accepted = not np.all(gains - _FIT_ERRORS * errors > PLAUSIBLE_GAINS[1])
    scale = np.ones(gains.size) if accepted else likely_factors(gains, PLAUSIBLE_GAINS)
    return CommandVerdict(
        explanation=AS_GIVEN if accepted else wrong_scale(scale, gains),
        accepted=accepted,
        repair=None if accepted else CommandRepair(scale=tuple(scale)),
        gain=frozen_copy(gains / scale),
        law=None,
    )


def find_scale(
    coarse: CoarseRecord,
    law: ControlLaw | None,
    guess: Guess,
    found: FloatArray,
    *,
    contrast: float,
    clear: float,
    plausible: tuple[float, float],
) -> FloatArray:
    """Return the factors (axes,) of commands that make implausible gains plausible ones.

    ``found`` are the gains (axes,) of a guess, ``contrast`` is its contrast there, and ``clear``
    what decides.
    """
    low, high = plausible
    bounded, nothing = np.clip(found, low, high), np.ones(found.size)
    if np.all(bounded == found):
        return nothing
    inside = np.geomspace(low, high, _INSIDE)
    near = coarse.profile(guess, np.tile(inside, (found.size, 1)))
    if np.sum(np.min(near, axis=1)) - contrast < clear:
        return nothing
    gains = fit_gains(coarse, guess, found)
    scale, usual = likely_factors(gains, plausible), _usual_gain(plausible)
    gain = float(np.exp(np.mean(np.log(gains))))
    if law is not None and law.is_sure:
        if not could_have_run(guess, inside[:, None] * nothing, coarse.record, law):
            return scale
        if gain < low:  # commands that are too large come from a law that is too strong
            return nothing
    shown = finer_saving_of_gain(coarse, guess, plausible, usual) >= clear
    return scale if shown else nothing


def _usual_gain(plausible: tuple[float, float]) -> float:
    """Return the gain that a sensor has most often."""
    return float(np.clip(_USUAL_GAIN, *plausible))


def likely_factors(gains: FloatArray, plausible: tuple[float, float]) -> FloatArray:
    """Return the likeliest factor of the commands of each axis with these gains, (axes,)."""
    low, high = plausible
    if np.max(gains) < _APART * np.min(gains):
        together = float(np.exp(np.mean(np.log(gains))))
        return np.full(gains.size, _likely_factor(together, plausible))
    each = [1.0 if low <= gain <= high else _likely_factor(gain, plausible) for gain in gains]
    return np.array(each)


def _likely_factor(gain: float, plausible: tuple[float, float]) -> float:
    """Return the likeliest factor of commands with a gain."""
    low, high = plausible
    usual = _usual_gain(plausible)
    fits = [f for f in _FACTORS if low <= gain / f <= high]
    fits = fits or [f for f in _FACTORS if low / _COARSE <= gain / f <= _COARSE * high]
    if fits:
        return float(min(fits, key=lambda f: abs(np.log(gain / f / usual))))
    return float(f"{gain / usual:.2g}")


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


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRepair:
    """A correction of recorded commands, in the order of the fields.

    Parameters
    ----------
    increments : bool, optional
        The record has increments: they are added up.
    shift_frames : int, optional
        Frames by which the commands move to later frames; negative to earlier ones.
    swap_axes : bool, optional
        The commands of the two axes change places.
    sign : tuple of int, optional
        1 or -1 for each axis, or for both.
    matrix : tuple of float, optional
        Matrix from commands to the axes of the measurements, in rows.
    scale : float or sequence of float, optional
        Factor of the commands of both axes, or of each: from volts or counts to the unit of the
        measurements, for example.

    Raises
    ------
    ProblemError
        If a value is out of range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lbt.identification.CommandRepair(sign=(-1,), scale=0.001).options
    '--command-sign -1 --command-scale 0.001'
    """

    increments: bool = False
    shift_frames: int = 0
    swap_axes: bool = False
    sign: tuple[int, ...] = ()
    matrix: tuple[float, ...] = ()
    scale: float | tuple[float, ...] = 1.0

    def __post_init__(self) -> None:
        given = self.scale if isinstance(self.scale, Sequence) else (self.scale,)
        scales = tuple(number(scale, "command_scale", above=0) for scale in given)
        set_fields(self, scale=scales[0] if len(set(scales)) == 1 else scales)
        shift = integer(self.shift_frames, "command_shift_frames", at_least=-_MOST_SHIFT)
        number(shift, "command_shift_frames", at_most=_MOST_SHIFT)
        if any(sign not in (-1, 1) for sign in self.sign):
            raise ProblemError(f"command_sign must be 1 or -1, per axis; got {list(self.sign)}.")
        real_array(self.matrix, "command_matrix")

    @property
    def options(self) -> str:
        """The options of the command line that do the same."""

        def values(each: tuple[float, ...]) -> str:
            return " ".join(f"{value:g}" for value in each)

        words = [
            "--command-increments" if self.increments else "",
            f"--command-shift-frames {self.shift_frames}" if self.shift_frames else "",
            "--swap-axes" if self.swap_axes else "",
            f"--command-sign {values(self.sign)}" if self.sign else "",
            f"--command-matrix {values(self.matrix)}" if self.matrix else "",
            f"--command-scale {values(self._scales)}" if self.scale != 1 else "",
        ]
        return " ".join(filter(None, words))

    @property
    def _scales(self) -> tuple[float, ...]:
        return self.scale if isinstance(self.scale, tuple) else (self.scale,)

    def turn(self, axes: int) -> FloatArray:
        """Return the matrix that swap, sign, matrix and scale are together."""
        if axes != 2 and self.swap_axes:
            raise ProblemError(
                "swapped commands need two axes; the record has one. Leave "
                f"{self.options} out, or choose two columns."
            )
        if len(self._scales) not in (1, axes):
            raise ProblemError(
                f"command_scale must be one factor, or {axes}; got {list(self._scales)}."
            )
        out = np.diag(np.broadcast_to(np.array(self._scales), axes))
        if self.matrix:
            if len(self.matrix) != axes**2:
                raise ProblemError(
                    f"command_matrix must have {axes**2} numbers for {axes} axes, row after row; "
                    f"got {len(self.matrix)}."
                )
            out = out @ np.reshape(self.matrix, (axes, axes))
        if self.sign:
            if len(self.sign) not in (1, axes):
                raise ProblemError(
                    f"command_sign must be one sign, or {axes}; got {list(self.sign)}."
                )
            out = out @ np.diag(np.broadcast_to(np.array(self.sign, dtype=float), axes))
        return out @ _SWAP if self.swap_axes else out


def repair_commands(record: LoopRecord, repair: CommandRepair) -> LoopRecord:
    """Return a closed-loop record with the commands that the mirror followed.

    The usable frames are those of the new commands. ProblemError refuses a record
    without commands, and a repair that does not fit its axes.
    """
    if record.commands is None:
        raise ProblemError("the record is of an open loop: it has no commands to repair.")
    commands = np.array(record.commands)
    good = np.ones(record.frames, dtype=np.bool_)
    if record.commanded is not None:
        good = np.array(record.commanded)
    if repair.increments:
        commands = np.cumsum(commands, axis=0)
        good &= np.logical_and.accumulate(good)
    if repair.shift_frames:
        commands = np.roll(commands, repair.shift_frames, axis=0)
        good = np.roll(good, repair.shift_frames)
        late = repair.shift_frames > 0
        unknown = slice(0, repair.shift_frames) if late else slice(repair.shift_frames, None)
        commands[unknown], good[unknown] = 0.0, False
    commands = commands @ repair.turn(record.axes).T
    repaired = replace(record, commands=read_only(commands), commanded=read_only(good))
    return repaired if record.delay_frames is None else repaired.with_delay(record.delay_frames)
