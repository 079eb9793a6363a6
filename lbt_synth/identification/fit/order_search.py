"""How many resonances a spectrum has, and which: forward search and backward pruning.

The model is grown from a background, turbulence over white noise: bands with too much power
become components, all parameters are fitted together, and whatever adds less to the logarithm
of the likelihood than a penalised criterion asks is dropped again. For a line of three
parameters among n values the Bayesian information criterion asks ``3 / 2 log n`` (G. Schwarz,
Ann. Statist. 6, 461 (1978), doi:10.1214/aos/1176344136).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.fit.line_candidates import (
    Candidate,
    find_candidates,
    measure_excess,
    smooth_background,
)
from lbt_synth.identification.fit.parameters import (
    NO_CORNER,
    FittedModel,
    Layout,
    Part,
    drop_part,
    has_corner,
    remove_component,
)
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.whittle import (
    CORNER,
    FIRST,
    GAIN,
    Likelihood,
    Minimum,
    add_observed_information,
    damping_parameter,
    damping_ratio,
    minimise,
)
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import BoolArray, FloatArray

_STARTING_GAINS = (0.35, 0.6, 1.0)
_FEW_ROUNDS = 3
_SAME_GAIN = 0.15  # of a logarithm
_MOST_TURBULENCES = 3
_ANNOUNCED = 5.0  # log-likelihood that a line whose frequency is known must add
_SPLIT = 9.0  # and the second of two that lie in each other's skirts
_HIGHEST = float(np.log(0.999 * np.pi))  # angle a frame of a line
_SHIFTS = np.arange(-2, 2.01, 0.25)  # bins, at which a narrow line is tried
_POWERS = (0.0, float(np.log(4)), float(-np.log(4)))
_MOST_ROUNDS = 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rules:
    """What the search may do."""

    gain: float | None  # Sensor gain, None to find it
    lowest_line_hz: float  # Below, a component is a part of the turbulence [Hz]
    most_lines: int  # Number of lines at most
    announced: Sequence[tuple[float, float]] = ()  # Lines known beforehand


def search_model(
    data: LoopPeriodogram, rules: Rules, start: FittedModel | None = None
) -> FittedModel:
    """Find the model of one axis."""
    search = _Search(data, rules)
    return search.measured(search.fitted_model(start))


def refit_model(data: LoopPeriodogram, rules: Rules, model: FittedModel) -> FittedModel | None:
    """Fit the parts of a model to other data, no more and no less; None if that fails."""
    return _Search(data, rules).refitted(model)


def gain_ambiguity(data: LoopPeriodogram, rules: Rules, best: FittedModel) -> float:
    """Find how far another model with another sensor gain is, that is nearly as likely.

    Wide resonances can stand for what a wrong gain leaves. Models are grown at other gains,
    which are then set free.
    """
    free = _Search(data, rules)
    least, gain = free.cost(best), float(best.theta[GAIN])
    away = 0.0
    for trial in _STARTING_GAINS:
        if abs(float(np.log(trial)) - gain) < _SAME_GAIN:
            continue
        fixed = _Search(data, replace(rules, gain=trial))
        try:
            other = fixed.fitted_model(None, rounds=_FEW_ROUNDS)
            made = free.fitted(other.theta, other.parts)
        except NumericalError:
            continue
        if free.cost(made) < least + free.need:
            away = max(away, abs(float(made.theta[GAIN]) - gain))
    return away


class _Search:
    def __init__(self, data: LoopPeriodogram, rules: Rules) -> None:
        self.data, self.rules = data, rules
        self.full = Likelihood(data)
        self.layout = Layout(data)
        self.need = self.layout.price
        self.free_gain = rules.gain is None and data.closed

    def fitted_model(self, start: FittedModel | None, *, rounds: int = _MOST_ROUNDS) -> FittedModel:
        """Find the model: grow, move, prune."""
        current = None if start is None else self.refitted(start)
        if current is None:
            current = self.begun()
        current = self.announced(self.pruned(current))
        for _ in range(rounds):
            found = self.excesses(current)
            better = self.extended(current, found) or self.moved(current)
            if better is None:
                break
            current = better
        return self.named(self.pruned(self.plain(current)))

    def asked(self, grown: FittedModel, i: int, *, earlier: bool = False) -> float:
        """Return what a component must add to the logarithm of the likelihood.

        Less, where its place was not searched for: a line that was announced, or one of a pair
        (of those before it only, where ``earlier``).
        """
        part, theta = grown.parts[i], grown.theta
        if part.frequency is not None:
            return _ANNOUNCED
        if part.line:
            centre, half = self.layout.place(theta, i)
            for j, other in enumerate(grown.parts[: i if earlier else None]):
                if other.line and j != i:
                    its_centre, its_half = self.layout.place(theta, j)
                    if abs(centre - its_centre) < 4 * (half + its_half):
                        return _SPLIT
        return self.need

    def begun(self) -> FittedModel:
        """Background and first lines, from the best of several sensor gains."""
        gains = _STARTING_GAINS if self.free_gain else (self.rules.gain or 1.0,)
        best: FittedModel | None = None
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

    def _background(self, gain: float) -> FittedModel:
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
        best: Minimum | None = None
        why: NumericalError | None = None
        for corner in (0.5, 5.0):
            theta = np.array(
                [
                    np.log(gain),
                    np.log(white),
                    self.layout.starting_corner(),
                    np.log(corner * self.layout.angle),
                    np.log(0.5),
                    np.log(slow),
                ]
            )
            free = np.ones(theta.size, dtype=bool)
            free[GAIN] = False
            try:
                got = minimise(
                    Likelihood(smooth), theta, self.layout.priors(theta, parts), free=free
                )
            except NumericalError as error:
                why = error
                continue
            if best is None or got.contrast < best.contrast:
                best = got
        if best is None:
            assert why is not None
            raise why
        return FittedModel(fitted=best, parts=parts)

    def _with(
        self, ground: FittedModel, found: list[Candidate]
    ) -> tuple[FloatArray, tuple[Part, ...]]:
        """Parameters and parts with candidates added."""
        theta, parts = [ground.theta], list(ground.parts)
        for c in found:
            line = c.frequency_hz >= self.rules.lowest_line_hz
            damping = np.clip(c.half_width_hz / c.frequency_hz, 1e-4, 0.3) if line else 0.3
            theta.append(self.layout.component(c.frequency_hz, float(damping), c.variance_nm2))
            parts.append(Part(line=line))
        whole = np.concatenate(theta)
        for i in range(len(ground.parts), len(parts)):
            whole = self._centred(whole, i)
        return whole, tuple(parts)

    def _centred(self, theta: FloatArray, i: int) -> FloatArray:
        """Parameters with a line that is hardly resolved at the best place within two bins.

        The sidelobes of the taper make as many places where a fit would stay.
        """
        step = self.layout.step
        centre, half = self.layout.place(theta, i)
        if half > 2 * step or centre <= 3 * step:
            return theta
        at = FIRST + PARAMETERS * i
        best, least = theta, self.full.contrast(theta)
        for shift in _SHIFTS * step:
            for power in _POWERS:
                trial = theta.copy()
                trial[at] += np.log1p(shift / centre)
                trial[at + 1] -= np.log1p(shift / centre)  # the width stays
                trial[at + 2] += power
                if (found := self.full.contrast(trial)) < least:
                    best, least = trial, found
        return best

    def announced(self, current: FittedModel) -> FittedModel:
        """Return the model with the lines that are known beforehand, those that are worth it.

        A line that is there already, within three errors, is taken for the announced one.
        """
        step, angle = self.layout.step, self.layout.angle
        theta, parts = [current.theta], list(current.parts)
        model = self.full.model(current.theta)
        for f, error in self.rules.announced:
            known = (float(np.log(f * angle)), max(error, 0.1 * step) / f)
            near = [
                i
                for i, part in enumerate(current.parts)
                if part.line
                and abs(self.layout.place(current.theta, i)[0] - f) < 3 * max(error, step)
            ]
            if near:
                parts[near[0]] = Part(line=True, frequency=known)
                continue
            level = float(np.interp(f, self.data.frequency_hz, model))
            theta.append(self.layout.component(f, 0.01, level * max(0.01 * f, step)))
            parts.append(Part(line=True, frequency=known))
        if not self.rules.announced:
            return current
        try:
            return self.pruned(self.fitted(np.concatenate(theta), tuple(parts)))
        except NumericalError:
            return current

    def excesses(self, current: FittedModel, *, first: bool = False) -> list[Candidate]:
        """Bands with too much power: the few best, or at first all clear ones."""
        theta = current.theta
        power = self.data.power(float(np.exp(theta[GAIN])))
        room = self._room(current)
        if room <= 0:
            return []
        found = find_candidates(
            self.data, power, self.full.model(theta), least=self.need, most=room
        )
        slow = sum(not part.line for part in current.parts)
        full = slow >= _MOST_TURBULENCES
        found = [c for c in found if not (full and c.frequency_hz < self.rules.lowest_line_hz)]
        if first:
            return [c for c in found if c.gain > max(2 * self.need, 0.02 * found[0].gain)]
        return [c for c in found if c.gain > 0.25 * found[0].gain]

    def _room(self, current: FittedModel) -> int:
        """How many lines more there may be."""
        return self.rules.most_lines - sum(part.line for part in current.parts)

    def named(self, current: FittedModel) -> FittedModel:
        """Let the first component be the turbulence, where a resonance took its place."""
        theta, lowest = current.theta, self.rules.lowest_line_hz * self.layout.angle
        slow = [
            i
            for i in range(1, len(current.parts))
            if np.exp(theta[FIRST + PARAMETERS * i]) < lowest
        ]
        ratio = damping_ratio(theta[FIRST + 1], first=True)
        if np.exp(theta[FIRST]) < lowest or not slow or has_corner(theta) or ratio > 0.98:
            return current
        i = max(slow, key=lambda i: float(theta[FIRST + PARAMETERS * i + 2]))
        at = FIRST + PARAMETERS * i
        swapped = theta.copy()
        swapped[FIRST : FIRST + 3], swapped[at : at + 3] = (
            theta[at : at + 3],
            theta[FIRST : FIRST + 3],
        )
        other = damping_ratio(theta[at + 1], first=False)
        swapped[FIRST + 1] = damping_parameter(other, first=True)
        swapped[at + 1] = damping_parameter(ratio, first=False)
        parts = list(current.parts)
        parts[i] = Part(line=True)
        try:
            made = self.fitted(swapped, tuple(parts))
        except NumericalError:
            return current
        return made if self.cost(made) < self.cost(current) + self.need else current

    def extended(self, current: FittedModel, found: list[Candidate]) -> FittedModel | None:
        """Return the model with the candidates that are worth it; None if none is."""
        while found:
            try:
                made = self.pruned(self.fitted(*self._with(current, found)))
            except NumericalError:
                made = None
            if made is not None and self.cost(made) < self.cost(current):
                return made
            found = found[: len(found) // 2]
        return None

    def plain(self, current: FittedModel) -> FittedModel:
        """Return the model without the roll-off of the turbulence, if that is not worth it."""
        theta = current.theta.copy()
        if not has_corner(theta):
            return current
        theta[CORNER] = np.log(2 * NO_CORNER)
        try:
            less = self.fitted(theta, current.parts)
        except NumericalError:
            return current
        worth = less.fitted.contrast - current.fitted.contrast
        return less if worth < self.need / PARAMETERS else current

    def moved(self, current: FittedModel) -> FittedModel | None:
        """Return the model with a line begun anew, or split in two; None if none is better."""
        data, theta = self.data, current.theta
        power = data.power(float(np.exp(theta[GAIN])))
        for i, part in enumerate(current.parts):
            if not part.line:
                continue
            at = FIRST + PARAMETERS * i
            centre, half = self.layout.place(theta, i)
            rest = self.full.model(remove_component(theta, i))
            reach = max(10 * half, 20 * self.layout.step)
            start, stop = np.searchsorted(data.frequency_hz, [centre - reach, centre + reach])
            seen = measure_excess(data, power, rest, int(start), int(stop))
            trials = []
            centred = self._centred(theta, i)
            if abs(centred[at] - theta[at]) * centre > 0.4 * self.layout.step:
                trials.append((centred, current.parts))
            if abs(seen.frequency_hz - centre) > 0.5 * half + self.layout.step:
                anew = theta.copy()
                anew[at : at + 3] = self.layout.component(
                    seen.frequency_hz,
                    min(seen.half_width_hz / seen.frequency_hz, 0.5),
                    seen.variance_nm2,
                )
                trials.append((anew, current.parts))
            if half > 3 * self.layout.step and self._room(current) > 0:
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
                if self.cost(made) < self.cost(current) - 1:
                    return made
        return None

    def cost(self, grown: FittedModel) -> float:
        """Contrast and what the criterion asks for all parts."""
        return grown.fitted.contrast + sum(
            self.asked(grown, i, earlier=True) for i in range(1, len(grown.parts))
        )

    def refitted(self, start: FittedModel) -> FittedModel | None:
        """Fit a model from elsewhere to these data; None if it does not settle."""
        theta = start.theta.copy()
        if not self.free_gain:
            theta[GAIN] = np.log(self.rules.gain or 1.0)
        if not has_corner(theta):
            theta[CORNER] = self.layout.starting_corner()
        try:
            return self.fitted(theta, start.parts)
        except NumericalError:
            return None

    def fitted(self, theta: FloatArray, parts: tuple[Part, ...]) -> FittedModel:
        """Fit all parameters; what leaves the band below the Nyquist frequency is dropped."""
        merged = Likelihood(self.data.merged(self.layout.groups(theta, parts)))
        got = minimise(merged, theta, self.layout.priors(theta, parts), free=self._free(theta))
        gone = [
            i for i in range(1, len(parts)) if got.parameters[FIRST + PARAMETERS * i] >= _HIGHEST
        ]
        if gone:
            left = [i for i in range(len(parts)) if i not in gone]
            kept = got.parameters
            for i in reversed(gone):
                kept = remove_component(kept, i)
            return self.fitted(kept, tuple(parts[i] for i in left))
        got = replace(got, contrast=self.full.contrast(got.parameters))
        return FittedModel(fitted=got, parts=parts)

    def measured(self, grown: FittedModel) -> FittedModel:
        """Return the model with what each part adds, and its exact information."""
        theta, parts = grown.theta, grown.parts
        less = [self.full.contrast(remove_component(theta, i)) for i in range(1, len(parts))]
        adds = [float("inf"), *(value - grown.fitted.contrast for value in less)]
        merged = Likelihood(self.data.merged(self.layout.groups(theta, parts)))
        exact = add_observed_information(
            merged, grown.fitted, self.layout.priors(theta, parts), free=self._free(theta)
        )
        return replace(grown, fitted=exact, evidence=tuple(adds))

    def _free(self, theta: FloatArray) -> BoolArray:
        free = np.ones(theta.size, dtype=np.bool_)
        free[GAIN] = self.free_gain
        free[CORNER] = has_corner(theta)
        return free

    def pruned(self, grown: FittedModel) -> FittedModel:
        """Drop what adds less than it must, the least first."""
        while len(grown.parts) > 1:
            base = grown.fitted.contrast
            trials = []
            for i in range(len(grown.parts)):
                less = drop_part(grown, i)
                if less is None:
                    continue
                asked = self.asked(grown, i)
                spare = self.full.contrast(less[0]) - base - 4 * asked
                if spare <= 0:
                    trials.append((spare, asked, less))
            for _, asked, less in sorted(trials, key=lambda trial: trial[0]):
                try:
                    made = self.fitted(*less)
                except NumericalError:
                    continue
                if made.fitted.contrast - base < asked:
                    grown = made
                    break
            else:
                return grown
        return grown
