"""What a guess about commands must pass beside the coarse likelihood: its loop and its fit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.identification.commands.control_law import ControlLaw, classify_matrix
from lbt_synth.identification.commands.guesses import SEGMENT_S, CoarseRecord, Comparison, Guess
from lbt_synth.identification.fit.fitting import GAINS, PLAUSIBLE_GAINS, Search, cost
from lbt_synth.identification.fit.order_search import FEW_ROUNDS, find_components, try_other_gains
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.fit.whittle import FittedModel
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.linear import Controller
from lbt_synth.loop import close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, FloatArray, number

_NEAR_ONE = 0.2  # distance from 1 of the pole of a law that adds up
_HIDDEN = 1e-7  # distance of poles at two gains that are the same
_STABLE = 1 - 1e-9  # spectral radius below which a loop has run
SHORT_LAW = 3  # order of a law that does not couple axes, and whose loop can be judged
CLEAR = 20.0  # nats that decide
_UNUSUAL = 10.0  # nats that a law asks for which no one would run
_CONTRADICTED = 60.0  # nats by which a guess is likelier than all that a law allows
_GENERAL = 5.0  # nats by which a matrix without a name, or part of a frame, must be likelier
_TRIED = np.array([[0.3], [0.7], [1.0]])  # gains at which a loop may have run
_NEARER = 0.2  # of the distance of a gain from the plausible ones, in its logarithm
_NEAR = 0.4  # such a distance that a coarse gain may have
_LIKE = 3.0  # factor between a coarse gain and the fitted one of the same record
_LINES = 10  # at most, of the search for lines

_Fit: TypeAlias = tuple[Search, FittedModel | None]


def already_integrates(law: ControlLaw) -> bool:
    """Return whether a law adds up measurements, as positions do and increments do not."""
    return bool(law.order > 0 and np.all(abs(law.poles[:, 0] - 1) < _NEAR_ONE))


def law_controller(law: ControlLaw, frame_rate_hz: float) -> Controller:
    """Return a control law as a controller, whose state holds past commands and measurements.

    ProblemError refuses the absence of a law, and one that knows measurements of the future.
    """
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    if law.kind == "none" or law.lag_frames < 0:
        why = (
            "the commands do not follow from the measurements"
            if law.kind == "none"
            else f"its commands know measurements of {-law.lag_frames} frames later"
        )
        raise ProblemError(f"a controller needs a law that can run; got one where {why}.")
    axes, lags = len(law.gain), law.taps.shape[1]
    last = law.lag_frames + lags - 1
    slots = max(law.order, 1)  # of u(k-1), u(k-2), ...; then last of y(k-1), y(k-2), ...
    size = axes * (slots + last)
    A, B = np.zeros((size, size)), np.zeros((size, axes))
    each = np.arange(axes)
    for j in range(law.order):
        A[each, axes * j + each] = law.past[:, j]
    for index in range(lags):
        lag = law.lag_frames + index
        if lag:
            column = axes * (slots + lag - 1)
            A[:axes, column : column + axes] += law.taps[:, index]
        else:
            B[:axes] += law.taps[:, index]
    for slot in range(1, slots):
        A[axes * slot + each, axes * (slot - 1) + each] = 1.0
    if last:
        B[axes * slots + each, each] = 1.0
    for slot in range(slots + 1, slots + last):
        A[axes * slot + each, axes * (slot - 1) + each] = 1.0
    return Controller(A=A, B=B, C=np.eye(axes, size), D=np.zeros((axes, axes)), dt_s=1 / rate)


def could_have_run(guess: Guess, gains: FloatArray, record: LoopRecord, law: ControlLaw) -> bool:
    """Return whether the recorded law would have been stable at any gains (n, axes) of a guess."""
    if guess.kind == "increments":
        return True  # another law computes the positions
    assert record.delay_frames is not None
    controller = law_controller(law, record.frame_rate_hz)
    axes = record.axes
    for gain in gains:
        path = LoopHardware(
            frame_rate_hz=record.frame_rate_hz,
            delay_frames=max(record.delay_frames + guess.shift_frames, 1.0),
            sensor_matrix=np.diag(gain),
            influence_matrix=np.eye(axes) if guess.matrix is None else guess.matrix,
            mirror=record.mirror,
        )
        if _moving_radius(path, controller) < _STABLE:
            return True
    return False


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


def score_guesses(
    compared: Comparison, record: LoopRecord, law: ControlLaw | None, lag: int
) -> tuple[FloatArray, BoolArray]:
    """Return the contrast of guesses with what their laws cost, and which laws are surprising.

    A loop that would have been unstable has not run.
    """
    unusual = np.array([_is_surprising(guess, law, lag) for guess in compared.guesses])
    possible = _possible_guesses(compared, record, law)
    surprising = unusual | ~possible
    best = int(np.argmin(compared.contrast))
    if law is not None and not law.exact and surprising[best]:
        expected = compared.contrast[:1] if surprising.all() else compared.contrast[~surprising]
        saved = np.min(expected) - compared.contrast[best]
        if saved > _CONTRADICTED * compared.dispersion(best):
            return score_guesses(compared, record, None, 0)  # it is not what computed the commands
    assert record.delay_frames is not None
    simple = np.array(
        [
            guess.is_simple and (record.delay_frames + guess.shift_frames) % 1 == 0
            for guess in compared.guesses
        ]
    )
    simple[0] = True
    score = compared.contrast + _UNUSUAL * unusual + _GENERAL * ~simple
    score[~possible] = np.inf
    if surprising[0] and not surprising.all():  # the law says what is wrong
        score[1:][surprising[1:]] = np.inf
        away = abs(np.log(compared.gain / np.clip(compared.gain, *PLAUSIBLE_GAINS))).max(axis=0)
        nearest = np.min(away[~surprising])
        memoryless = law is not None and law.order == 0  # it would hold nothing
        if nearest < (_NEAR if memoryless else _NEARER * away[0]):  # and so does the sensor
            score[0] = np.inf
    return score, surprising


def _possible_guesses(
    compared: Comparison, record: LoopRecord, law: ControlLaw | None
) -> BoolArray:
    """Return which guesses make loops that have run; all where no law tells."""
    every = np.ones(len(compared.guesses), dtype=np.bool_)
    if law is None or not law.is_sure:
        return every
    tried = _TRIED * np.ones(record.axes)
    each = zip(compared.guesses, compared.gain.T, strict=True)
    possible = np.array(
        [
            could_have_run(guess, np.vstack([gain, 0.3 * gain, *tried]), record, law)
            for guess, gain in each
        ]
    )
    return possible if possible.any() else every


def _is_surprising(guess: Guess, law: ControlLaw | None, lag: int) -> bool:
    """Return whether a guess makes the control law one that no one would run."""
    if law is None or law.kind == "none":
        return guess.shift_frames != 0
    if guess.kind == "shift":
        return guess.shift_frames != -lag or lag == 0
    if guess.kind == "as given" and lag:
        return True
    if (guess.kind == "increments") == already_integrates(law):
        return True
    matrix = np.eye(len(law.gain)) if guess.matrix is None else guess.matrix
    turned = classify_matrix(matrix @ law.gain)
    if turned.kind == "swapped" or min(turned.signs) < 0:
        return True
    # a long law may couple the axes, as a filter of lines along diagonals does
    return turned.kind != "diagonal" and law.order <= SHORT_LAW


def finer_saving(coarse: CoarseRecord, guess: Guess, clear: float) -> float:
    """Return how much likelier a guess is than the record as given, by the model of the fit.

    Both have the lines and the wide resonances that they need, at the price of the criterion: the
    coarse spectrum has few. Before a saving is clear, the record as given is fitted from other
    gains as well.
    """
    as_given = Guess(kind="as given")
    other = _cost(_fit_axes(coarse, guess))
    saving = _cost(_fit_axes(coarse, as_given)) - other
    if saving < clear:
        return saving
    return _cost(_fit_axes(coarse, as_given, other_gains=True)) - other


def finer_saving_of_gain(
    coarse: CoarseRecord, guess: Guess, plausible: tuple[float, float], usual: float
) -> float:
    """Return how much likelier any gain is than plausible ones, by the model of the fit."""
    low, high = plausible
    free = _fit_axes(coarse, guess)
    if all(model is not None and low <= model.spectrum.gain <= high for _, model in free):
        return 0.0
    held = min(_cost(_fit_axes(coarse, guess, gain)) for gain in (low, usual, high))
    return held - _cost(free)


def fit_gains(coarse: CoarseRecord, guess: Guess, gains: FloatArray) -> FloatArray:
    """Return the gains (axes,) of a guess by the model of the fit; the coarse ones where it fails.

    Wide resonances that the coarse spectrum lacks move its gains.
    """
    if not np.all((gains > GAINS["above"]) & (gains < GAINS["below"])):
        return gains
    fits = _fit_axes(coarse, guess, begin_at=gains)
    fitted = np.array([np.nan if model is None else model.spectrum.gain for _, model in fits])
    return np.where(np.abs(np.log(fitted / gains)) < np.log(_LIKE), fitted, gains)


def _cost(fits: Sequence[_Fit]) -> float:
    """Return the criterion over all axes; infinite where a fit failed."""
    return sum(np.inf if model is None else cost(search, model) for search, model in fits)


def _fit_axes(
    coarse: CoarseRecord,
    guess: Guess,
    gain: float | None = None,
    *,
    other_gains: bool = False,
    begin_at: FloatArray | None = None,
) -> list[_Fit]:
    """Return the best model of each axis for a guess, at any gain or at one.

    Any gain is looked for from several, or from one for each axis (axes,) where they are given.
    """
    record = coarse.record
    corrections = coarse.corrections(guess)
    length = int(SEGMENT_S * record.frame_rate_hz)
    pieces = [
        (start, min(start + length, b))
        for a, b in coarse.stretches
        for start in range(a, max(b - length, a) + 1, length)
    ]
    out: list[_Fit] = []
    for i, (y, c) in enumerate(zip(record.measurements.T, corrections.T, strict=True)):
        data = loop_periodogram(y, c, frame_rate_hz=record.frame_rate_hz, stretches=pieces)
        search = Search(data=data, gain=gain, most_lines=_LINES)
        if begin_at is not None:
            search = replace(search, starting_gains=(float(begin_at[i]),))
        found: FittedModel | None = None
        with suppress(NumericalError):
            found = find_components(search, None, rounds=FEW_ROUNDS)
            if other_gains:
                found, _ = try_other_gains(search, found)
        out.append((search, found))
    return out
