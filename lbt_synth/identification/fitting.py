"""How many resonances a spectrum has, and which: forward search and backward pruning.

The model is grown from a background, turbulence over white noise: bands with too much power
become components, all parameters are fitted together, and whatever adds less to the logarithm
of the likelihood than a penalised criterion asks is dropped again. For a line of three
parameters among n values the Bayesian information criterion asks ``3 / 2 log n`` (G. Schwarz,
Ann. Statist. 6, 461 (1978), doi:10.1214/aos/1176344136).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.components import PARAMETERS
from lbt_synth.identification.periodogram import LoopPeriodogram
from lbt_synth.identification.search import Candidate, candidates, shape_of, smooth_background
from lbt_synth.identification.whittle import (
    CORNER,
    FIRST,
    GAIN,
    Fitted,
    Likelihood,
    Priors,
    damping_parameter,
    damping_ratio,
    fit,
)
from lbt_synth.validation import FloatArray, IntArray

_STARTING_GAINS = (0.35, 0.6, 1.0)
_GAIN_PRIOR = (np.log(0.7), 1.0)
_TURBULENCE_DAMPING = (np.log(0.5), 0.7)  # of the first component; of others the odds
_PART_DAMPING = (0.0, 1.0)
_LINE_DAMPING = (np.log(0.01 / 0.99), 2.0)
_NO_CORNER = 50.0  # angle a frame of a corner that is none
_CORNER = (np.log(50.0), 2.0)  # of its frequency [Hz]
_SLOWEST = 3.0  # width of the prior on the logarithm of a turbulence's frequency
_MOST_TURBULENCES = 3
_ANNOUNCED = 5.0  # log-likelihood that a line whose frequency is known must add
_SPLIT = 9.0  # and the second of two that lie in each other's skirts
_MOST_ROUNDS = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What a component of the model is.

    Attributes
    ----------
    line : bool
        Whether it is a line, or a part of the turbulence.
    frequency : (mean, deviation) or None
        Prior of the logarithm of its frequency, as an angle a frame.
    """

    line: bool
    frequency: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rules:
    """What the search may do.

    Attributes
    ----------
    gain : float or None
        Sensor gain, None to find it.
    lowest_line_hz : float
        Below, a component is a part of the turbulence [Hz].
    most_lines : int
        Number of lines at most.
    announced : sequence of (frequency [Hz], error [Hz])
        Lines known beforehand.
    """

    gain: float | None
    lowest_line_hz: float
    most_lines: int
    announced: Sequence[tuple[float, float]] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grown:
    """A fitted model with the meaning of its parts.

    Attributes
    ----------
    fitted : Fitted
        The minimum; its contrast is that of all values, without priors.
    parts : tuple of Part
        One a component.
    adds : tuple of float
        What each component adds to the logarithm of the likelihood, the others refitted or not.
    """

    fitted: Fitted
    parts: tuple[Part, ...]
    adds: tuple[float, ...] = field(default=())

    @property
    def theta(self) -> FloatArray:
        """The parameters."""
        return self.fitted.parameters


def grow(data: LoopPeriodogram, rules: Rules, start: Grown | None = None) -> Grown:
    """Find the model of one axis.

    Parameters
    ----------
    data : LoopPeriodogram
        The periodogram.
    rules : Rules
        What may be done.
    start : Grown, optional
        The model to begin with, for instance that of a moment ago.

    Returns
    -------
    Grown
        The model.

    Raises
    ------
    NumericalError
        If no start leads to a minimum.
    """
    search = _Search(data, rules)
    current = search.refitted(start) if start is not None else None
    if current is None:
        current = search.begun()
    current = search.pruned(current)
    for _ in range(_MOST_ROUNDS):
        found = search.excesses(current)
        better = search.extended(current, found) or search.moved(current)
        if better is None:
            break
        current = better
    return search.pruned(search.plain(current), measure=True)


def has_corner(theta: FloatArray) -> bool:
    """Whether the turbulence rolls off behind a corner."""
    return bool(theta[CORNER] < np.log(_NO_CORNER))


class _Search:
    def __init__(self, data: LoopPeriodogram, rules: Rules) -> None:
        self.data, self.rules = data, rules
        self.full = Likelihood(data)
        self.angle = 2 * np.pi / data.frame_rate_hz
        self.step = float(np.median(np.diff(data.frequency_hz)))
        self.need = 0.5 * PARAMETERS * float(np.log(max(2.0, np.sum(data.count))))
        self.free_gain = rules.gain is None and data.closed

    def asked(self, grown: Grown, i: int, *, earlier: bool = False) -> float:
        """Return what a component must add to the logarithm of the likelihood.

        Less, where its place was not searched for: a line that was announced, or one of a pair
        (of those before it only, where ``earlier``).
        """
        part, theta = grown.parts[i], grown.theta
        if part.frequency is not None:
            return _ANNOUNCED
        if part.line:
            centre, half = self._place(theta, i)
            for j, other in enumerate(grown.parts[: i if earlier else None]):
                if other.line and j != i:
                    its_centre, its_half = self._place(theta, j)
                    if abs(centre - its_centre) < 4 * (half + its_half):
                        return _SPLIT
        return self.need

    def _place(self, theta: FloatArray, i: int) -> tuple[float, float]:
        """Frequency and half width of a component [Hz], the width at least a bin."""
        at = FIRST + PARAMETERS * i
        centre = float(np.exp(theta[at])) / self.angle
        ratio = damping_ratio(theta[at + 1], first=i == 0)
        return centre, max(centre * ratio, self.step)

    def _component(self, frequency_hz: float, damping: float, variance: float) -> FloatArray:
        """Parameters of a component that is not the first."""
        odds = damping_parameter(damping, first=False)
        return np.array([np.log(frequency_hz * self.angle), odds, np.log(variance)])

    def begun(self) -> Grown:
        """Background and first lines, from the best of several sensor gains."""
        gains = _STARTING_GAINS if self.free_gain else (self.rules.gain or 1.0,)
        best: Grown | None = None
        why: NumericalError | None = None
        for gain in gains:
            try:
                ground = self._background(gain)
                first = self.excesses(ground, first=True)
                made = self.fitted(*self._with(ground, first))
            except NumericalError as error:
                why = error
                continue
            if best is None or made.fitted.contrast < best.fitted.contrast:
                best = made
        if best is None:
            assert why is not None
            raise why
        return best

    def _background(self, gain: float) -> Grown:
        """Turbulence and noise, fitted to medians over bands: lines hardly touch them."""
        data = self.data
        f, d, weight = smooth_background(data.power(gain), data.frequency_hz, data.count)
        zero = np.zeros_like(f)
        smooth = replace(
            data, frequency_hz=f, measured=d, crossed=zero, corrected=zero, count=weight
        )
        white = float(np.median(d[f >= 0.6 * f[-1]])) * data.frame_rate_hz / 2
        total = float(np.sum(np.diff(f) * (d[1:] + d[:-1]) / 2))
        slow = max(total - white, 0.1 * white)
        parts = (Part(line=False),)
        best: Fitted | None = None
        why: NumericalError | None = None
        for corner in (0.5, 5.0):
            theta = np.array(
                [
                    np.log(gain),
                    np.log(white),
                    np.log(50.0 * self.angle),
                    np.log(corner * self.angle),
                    np.log(0.5),
                    np.log(slow),
                ]
            )
            free = np.ones(theta.size, dtype=bool)
            free[GAIN] = False
            try:
                got = fit(Likelihood(smooth), theta, self._priors(theta, parts), free=free)
            except NumericalError as error:
                why = error
                continue
            if best is None or got.contrast < best.contrast:
                best = got
        if best is None:
            assert why is not None
            raise why
        return Grown(fitted=best, parts=parts)

    def _with(self, ground: Grown, found: list[Candidate]) -> tuple[FloatArray, tuple[Part, ...]]:
        """Parameters and parts with candidates (and announced lines, at first) added."""
        theta, parts = [ground.theta], list(ground.parts)
        for c in found:
            line = c.frequency_hz >= self.rules.lowest_line_hz
            damping = np.clip(c.half_width_hz / c.frequency_hz, 1e-4, 0.3) if line else 0.3
            theta.append(self._component(c.frequency_hz, float(damping), c.variance_nm2))
            parts.append(Part(line=line))
        if all(p.frequency is None for p in ground.parts):
            model = self.full.model(ground.theta)
            for f, error in self.rules.announced:
                width = max(error, self.step)
                known = (float(np.log(f * self.angle)), max(error, 0.1 * self.step) / f)
                near = [
                    i
                    for i, p in enumerate(parts)
                    if p.line and abs(np.exp(self._at(theta, i)[0]) / self.angle - f) < 3 * width
                ]
                if near:
                    parts[near[0]] = Part(line=True, frequency=known)
                    continue
                level = float(np.interp(f, self.data.frequency_hz, model))
                theta.append(self._component(f, 0.01, level * max(0.01 * f, self.step)))
                parts.append(Part(line=True, frequency=known))
        return np.concatenate(theta), tuple(parts)

    @staticmethod
    def _at(theta: list[FloatArray], i: int) -> FloatArray:
        whole = np.concatenate(theta)
        return whole[FIRST + PARAMETERS * i : FIRST + PARAMETERS * (i + 1)]

    def excesses(self, current: Grown, *, first: bool = False) -> list[Candidate]:
        """Bands with too much power: the few best, or at first all clear ones."""
        theta = current.theta
        power = self.data.power(float(np.exp(theta[GAIN])))
        lines = sum(p.line for p in current.parts)
        room = self.rules.most_lines - lines
        if room <= 0:
            return []
        found = candidates(
            self.data, power, self.full.model(theta), least=self.need, most=max(1, room)
        )
        full = len(current.parts) - lines >= _MOST_TURBULENCES
        found = [c for c in found if not (full and c.frequency_hz < self.rules.lowest_line_hz)]
        if first:
            return [c for c in found if c.gain > max(2 * self.need, 0.02 * found[0].gain)]
        return [c for c in found if c.gain > 0.25 * found[0].gain]

    def extended(self, current: Grown, found: list[Candidate]) -> Grown | None:
        """Return the model with the candidates that are worth it; None if none is."""
        while found:
            try:
                made = self.pruned(self.fitted(*self._with(current, found)))
            except NumericalError:
                made = None
            if made is not None and self._cost(made) < self._cost(current):
                return made
            found = found[: len(found) // 2]
        return None

    def plain(self, current: Grown) -> Grown:
        """Return the model without the roll-off of the turbulence, if that is not worth it."""
        theta = current.theta.copy()
        if not has_corner(theta):
            return current
        theta[CORNER] = np.log(2 * _NO_CORNER)
        try:
            less = self.fitted(theta, current.parts)
        except NumericalError:
            return current
        return (
            less
            if less.fitted.contrast - current.fitted.contrast < self.need / PARAMETERS
            else current
        )

    def moved(self, current: Grown) -> Grown | None:
        """Return the model with a line begun anew, or split in two; None if none is better."""
        data, theta = self.data, current.theta
        power = data.power(float(np.exp(theta[GAIN])))
        for i, part in enumerate(current.parts):
            if not part.line:
                continue
            at = FIRST + PARAMETERS * i
            centre, half = self._place(theta, i)
            without = self._without(theta, i)
            rest = self.full.model(without)
            reach = max(10 * half, 20 * self.step)
            start, stop = np.searchsorted(data.frequency_hz, [centre - reach, centre + reach])
            seen = shape_of(data, power, rest, int(start), int(stop))
            trials = []
            if abs(seen.frequency_hz - centre) > 0.5 * half + self.step:
                anew = theta.copy()
                anew[at : at + 3] = self._component(
                    seen.frequency_hz,
                    min(seen.half_width_hz / seen.frequency_hz, 0.5),
                    seen.variance_nm2,
                )
                trials.append((anew, current.parts))
            if half > 3 * self.step:
                pair = theta[at : at + 3] + np.log(
                    [[1 - half / centre, 0.5, 0.5], [1 + half / centre, 0.5, 0.5]]
                )
                split = np.concatenate([theta, pair[1]])
                split[at : at + 3] = pair[0]
                trials.append((split, (*current.parts, Part(line=True))))
            for trial, parts in trials:
                try:
                    made = self.pruned(self.fitted(trial, parts))
                except NumericalError:
                    continue
                if self._cost(made) < self._cost(current) - 1:
                    return made
        return None

    def _cost(self, grown: Grown) -> float:
        return grown.fitted.contrast + sum(
            self.asked(grown, i, earlier=True) for i in range(1, len(grown.parts))
        )

    def refitted(self, start: Grown) -> Grown | None:
        """Fit a model from elsewhere to these data; None if it does not settle."""
        theta = start.theta.copy()
        if not self.free_gain:
            theta[GAIN] = np.log(self.rules.gain or 1.0)
        if not has_corner(theta):
            theta[CORNER] = _CORNER[0] + np.log(self.angle)
        try:
            return self.fitted(theta, start.parts)
        except NumericalError:
            return None

    def fitted(self, theta: FloatArray, parts: tuple[Part, ...]) -> Grown:
        """Fit all parameters."""
        merged = self.data.merged(self._groups(theta, parts))
        free = np.ones(theta.size, dtype=bool)
        free[GAIN] = self.free_gain
        free[CORNER] = has_corner(theta)
        got = fit(Likelihood(merged), theta, self._priors(theta, parts), free=free)
        got = replace(got, contrast=self.full.contrast(got.parameters))
        return Grown(fitted=got, parts=parts)

    def pruned(self, grown: Grown, *, measure: bool = False) -> Grown:
        """Drop what adds less than it must, the least first."""
        while len(grown.parts) > 1:
            base = grown.fitted.contrast
            adds = [
                self.full.contrast(self._without(grown.theta, i)) - base
                for i in range(1, len(grown.parts))
            ]
            asked = [self.asked(grown, i) for i in range(1, len(grown.parts))]
            spare = [a - 4 * b for a, b in zip(adds, asked, strict=True)]
            for i in 1 + np.argsort(spare):
                if spare[i - 1] > 0:
                    continue
                parts = grown.parts[:i] + grown.parts[i + 1 :]
                try:
                    less = self.fitted(self._without(grown.theta, int(i)), parts)
                except NumericalError:
                    continue
                adds[i - 1] = less.fitted.contrast - base
                if adds[i - 1] < asked[i - 1]:
                    grown = less
                    break
            else:
                return replace(grown, adds=(np.inf, *adds)) if measure else grown
        return replace(grown, adds=(np.inf,)) if measure else grown

    @staticmethod
    def _without(theta: FloatArray, i: int) -> FloatArray:
        at = FIRST + PARAMETERS * i
        return np.delete(theta, slice(at, at + PARAMETERS))

    def _priors(self, theta: FloatArray, parts: tuple[Part, ...]) -> Priors:
        centre, width = theta.copy(), np.full(theta.size, np.inf)
        centre[GAIN], width[GAIN] = _GAIN_PRIOR
        if has_corner(theta):
            centre[CORNER], width[CORNER] = _CORNER[0] + np.log(self.angle), _CORNER[1]
        for i, part in enumerate(parts):
            at = FIRST + PARAMETERS * i
            slow = _PART_DAMPING if i else _TURBULENCE_DAMPING
            centre[at + 1], width[at + 1] = _LINE_DAMPING if part.line else slow
            if part.frequency is not None:
                centre[at], width[at] = part.frequency
            elif not part.line:
                centre[at], width[at] = np.log(self.angle), _SLOWEST
        return Priors(centre=centre, width=width)

    def _groups(self, theta: FloatArray, parts: tuple[Part, ...]) -> IntArray:
        """Return the begin of groups of bins over which the model is nearly constant."""
        f = self.data.frequency_hz
        size = np.maximum(self.step, np.minimum(0.02 * f, 3.0))
        for i, part in enumerate(parts):
            if not part.line:
                continue
            centre, half_width = self._place(theta, i)
            away = np.maximum(np.abs(f - centre) - 10 * self.step, 0)
            np.minimum(
                size, np.maximum(self.step, 0.1 * np.maximum(half_width, 2 * away)), out=size
            )
        place = np.floor(np.cumsum(self.step / size) - 1e-9)
        return np.flatnonzero(np.concatenate([[True], np.diff(place) > 0]))
