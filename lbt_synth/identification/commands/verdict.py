"""The verdict on the commands of a record: whether they reach its measurements as given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lbt_synth.errors import ProblemError, RecordError
from lbt_synth.identification.commands.coarse_steps import doubt_steps, gain_dilution, note_steps
from lbt_synth.identification.commands.control_law import ControlLaw, record_control_law
from lbt_synth.identification.commands.explanations import (
    invert_axes,
    recorded_early,
    refine_guess,
    repair_guess,
    wrong_scale,
)
from lbt_synth.identification.commands.guesses import (
    SHIFTS,
    CoarseRecord,
    Comparison,
    Guess,
    list_guesses,
)
from lbt_synth.identification.commands.held_commands import held_while_moving
from lbt_synth.identification.commands.law_doubts import (
    doubt_axes,
    doubt_law,
    doubt_running,
    find_slip,
    moving_axes,
)
from lbt_synth.identification.commands.plausibility import finer_saving, score_guesses
from lbt_synth.identification.commands.repair import CommandRepair, repair_commands
from lbt_synth.identification.commands.scale_search import find_scale
from lbt_synth.identification.fit.fitting import PLAUSIBLE_GAINS
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, FloatArray, frozen_copy, require_instance

AS_GIVEN = "as given"
_CLEAR = 20.0  # nats that decide
_CLEAR_FINER = 8.0  # the same by the criterion of the fit, where a shift is of whole frames
_PART = 0.5  # frame, which the dynamics of a mirror may imitate: only a warning
_RELATED = 60.0  # nats by which commands without a law must be likelier than none
_ABSURD = 3e4  # scale of commands without a law that are rather of another night
_NO_UNIT = 1e12  # scale that no two units of a length or an angle have
_NOT_SHOWN = 3.0  # factor beyond plausible gains
_WRONG_GAIN = 2.0  # factor between a given gain and what the record shows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandVerdict:
    """How the commands of a record reach its measurements.

    Attributes
    ----------
    explanation : str
        What explains the record best, in words; "as given" if that is what was given.
    accepted : bool
        Whether a model may be fitted.
    repair : CommandRepair or None
        What the commands need; None where nothing is wrong or nothing helps.
    delay_frames : float or None
        The delay that fits, where another was given.
    nats : float
        Logarithm of the likelihood of the explanation over that of the record as given; 0 where
        the control law alone decides.
    gain : (axes,) ndarray
        Coarse sensor gain of the explanation; nan where it is far from any plausible one, because
        the coarse spectrum does not show it.
    law : ControlLaw or None
        The control law of the record; None where too few frames show it.
    notes : tuple of str
        What to look at although the record is accepted.
    """

    explanation: str
    accepted: bool
    repair: CommandRepair | None = None
    delay_frames: float | None = None
    nats: float = 0.0
    gain: FloatArray
    law: ControlLaw | None
    notes: tuple[str, ...] = ()

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
        """Refuse a record that is explained better by something else.

        Raises
        ------
        RecordError
            With the explanation, and the options that repair the record.
        """
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
    """Compare explanations of how the commands of a record reach its measurements.

    Each explanation gives another pseudo-open-loop series, and only the right one has the simple
    spectrum of turbulence, lines and noise: Whittle's likelihood on a coarse model decides between
    the commands as given, turned, exchanged or rotated ones, other delays, increments, requests
    beyond the stroke, other units, and commands that have nothing to do with the measurements.
    The control law that computed the commands tells a shifted record from a wrong delay.

    Parameters
    ----------
    record : LoopRecord
        A closed-loop record with its delay.
    sensor_gain : float or one per axis, optional
        Known gain of the sensor; by default anything from 0.2 to 1.25 is plausible.

    Returns
    -------
    CommandVerdict
        The best explanation, and what repairs the record.

    Raises
    ------
    ProblemError
        If the record has no commands or no delay.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.4).controller, truth, hardware=path, frames=10_000
    ... )
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], -run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> lbt.identification.explain_commands(record).options
    '--command-sign -1'
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
    dilution = gain_dilution(coarse)
    steps = doubt_steps(coarse, dilution) if sensor_gain is None else None
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
    words = [] if not early else [recorded_early(early)]
    repair, other_delay, why = repair_guess(found.guess, delay, max(lag, 0))
    words += why
    if np.any(scale != 1):
        words.append(wrong_scale(scale, found.gain))
    if steps and not words:
        words.append(steps)
    rounded = note_steps(coarse, dilution) if sensor_gain is None else ()
    repair = replace(repair, shift_frames=repair.shift_frames or early, scale=tuple(scale))
    return CommandVerdict(
        explanation=" and ".join(words) or AS_GIVEN,
        accepted=not words,
        repair=repair if repair.options else None,
        delay_frames=other_delay,
        nats=max(found.nats, 0.0),
        gain=_shown_gain(found.gain / scale, plausible),
        law=law,
        notes=() if words else (*_notes(found, delay, lag), *rounded),
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
    if law is not None and law.is_sure and (doubt := doubt_law(law)):
        return doubt
    return None if law is not None and law.is_whole else find_slip(record)


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
    own_contrast: float  # of the axes, without their coherence
    gain: FloatArray  # (axes,)
    clear: float  # nats that decide
    rival: Guess | None = None  # a likelier one that is not clearly so
    rival_nats: float = 0.0

    def scale(
        self, coarse: CoarseRecord, law: ControlLaw | None, plausible: tuple[float, float]
    ) -> FloatArray:
        """Return the factors of commands that make implausible gains plausible ones."""
        decides = {"own_contrast": self.own_contrast, "clear": self.clear}
        return find_scale(coarse, law, self.guess, self.gain, plausible=plausible, **decides)


def _find_best(coarse: CoarseRecord, law: ControlLaw | None, lag: int) -> _Best | None:
    """Return the best explanation; None where commands do not reach the measurements."""
    record = coarse.record
    guesses = list_guesses(record, earliest_frames=1.0 - lag)
    if lag > SHIFTS[-1]:
        guesses.append(Guess(kind="shift", shift_frames=-float(lag)))
    if law is not None and law.axis_matrix.kind not in ("diagonal", "swapped", "zero"):
        inverse = invert_axes(law.gain)
        guesses += [] if inverse is None else [Guess(kind="matrix", matrix=inverse)]
    compared = coarse.compare(guesses)
    if any(guess.kind == "clipped" for guess in guesses):
        guesses.append(_best_limits(compared))
        compared = compared.join(coarse.compare(guesses[-1:]))
    score, surprising = score_guesses(compared, record, law, lag)
    best = int(np.argmin(score))
    # what the law asks for, which the coarse spectrum may miss
    expected = np.flatnonzero(~surprising)
    if surprising[[0, best]].all() and expected.size:
        other = int(expected[np.argmin(score[expected])])
        saving = finer_saving(coarse, guesses[other], clear=_CLEAR_FINER, decides=True)
        if saving >= _CLEAR_FINER:
            best, score[0] = other, np.inf
    clear = _CLEAR * compared.dispersion(best)
    no_law = law is None or law.kind == "none"
    saved = coarse.unrelated() - np.min(compared.contrast) if no_law else np.inf
    if saved < _RELATED * compared.dispersion(best):
        return None
    given = _Best(
        guess=guesses[0],
        nats=0.0,
        own_contrast=float(np.sum(compared.axis_contrast[:, 0])),
        gain=compared.gain[:, 0],
        clear=clear,
    )
    if best == 0:
        return given
    nats = float(compared.contrast[0] - compared.contrast[best])
    part_of_a_frame = abs(guesses[best].shift_frames) == _PART
    guess = refine_guess(coarse, guesses[best], law)
    shown = nats >= clear / 2 or np.isinf(score[0])
    finer = 0.0
    if not surprising[0] or surprising[best]:  # the law does not ask for it
        least = _CLEAR_FINER if guess.shift_frames % 1 == 0 else _CLEAR
        if nats >= clear:
            finer = finer_saving(coarse, guess, clear=least, decides=not part_of_a_frame)
        shown = finer >= least and not part_of_a_frame
    if not shown:
        return replace(given, rival=guesses[best], rival_nats=finer)
    fine = coarse.compare([guess])
    return _Best(
        guess=guess,
        nats=nats,
        own_contrast=float(np.sum(fine.axis_contrast[:, 0])),
        gain=fine.gain[:, 0],
        clear=clear,
    )


def _best_limits(compared: Comparison) -> Guess:
    """Return the guess of clipped commands with the best limit of each axis."""
    places = [i for i, guess in enumerate(compared.guesses) if guess.limit_nm is not None]
    limits = np.array([compared.guesses[i].limit_nm for i in places])
    best = np.argmin(compared.axis_contrast[:, places], axis=1)
    return Guess(kind="clipped", limit_nm=limits[best, np.arange(best.size)])


def _notes(found: _Best, delay_frames: float, lag: int) -> tuple[str, ...]:
    """Return what to look at although the record is accepted."""
    out = []
    if lag > 0:
        out.append(
            f"warning: the commands follow measurements {count_text(lag, 'frame')} earlier. If "
            "the real-time computer takes that long, the total delay of a new design is "
            f"{delay_frames + lag:g} frames"
        )
    rival = found.rival if found.rival_nats > 0.5 * _CLEAR_FINER else None
    if rival is not None and rival.kind == "shift":
        fitting = delay_frames + rival.shift_frames
        out.append(
            f"warning: a delay of {fitting:g} frames fits better than {delay_frames:g} (by "
            f"{found.rival_nats:.0f} in the logarithm of the likelihood). Check the delay"
        )
    return tuple(out)
