"""The search for the resonances of a spectrum, and for their number.

The model grows from a background, turbulence over white noise: bands with too much power
become components, all parameters are fitted together, and whatever adds less to the logarithm
of the likelihood than a penalised criterion asks is dropped again. For a line of three
parameters among n values the Bayesian information criterion asks ``3 / 2 log n`` (G. Schwarz,
Ann. Statist. 6, 461 (1978), doi:10.1214/aos/1176344136).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.fit.line_candidates import (
    Candidate,
    find_candidates,
    measure_excess,
    smooth_background,
)
from lbt_synth.identification.fit.model_fitter import ModelFitter, Rules, likeliest
from lbt_synth.identification.fit.parameters import (
    FittedModel,
    Part,
    has_corner,
    promote_component,
    remove_component,
    strongest,
)
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.whittle import (
    DAMPING,
    FREQUENCY,
    GAIN,
    Likelihood,
    component,
    damping_parameter,
    damping_ratio,
    minimise,
)
from lbt_synth.validation import FloatArray

_STARTING_GAINS = (0.35, 0.6, 1.0)
_STARTING_FREQUENCIES_HZ = (0.5, 5.0)  # of the turbulence
_FEW_ROUNDS = 3
_MOST_ROUNDS = 12
_SAME_GAIN = 0.15  # of a logarithm
_MOST_TURBULENCES = 3


def search_model(
    data: LoopPeriodogram, rules: Rules, start: FittedModel | None = None
) -> FittedModel:
    """Find the model of one axis."""
    search = _Search(data, rules)
    return search.add_evidence(search.run(start))


def gain_ambiguity(data: LoopPeriodogram, rules: Rules, best: FittedModel) -> float:
    """Return how far the gain of another, nearly as likely model is, as a logarithm.

    Wide resonances can stand for what a wrong gain leaves. Models are searched for at other
    gains, which are then set free.
    """
    free = _Search(data, rules)
    least, gain = free.cost(best), float(best.theta[GAIN])
    away = 0.0
    for trial in _STARTING_GAINS:
        if abs(float(np.log(trial)) - gain) < _SAME_GAIN:
            continue
        fixed = _Search(data, replace(rules, gain=trial))
        try:
            other = fixed.run(None, rounds=_FEW_ROUNDS)
        except NumericalError:
            continue
        made = free.try_fit(other.theta, other.parts)
        if made is not None and free.cost(made) < least + free.price:
            away = max(away, abs(float(made.theta[GAIN]) - gain))
    return away


class _Search(ModelFitter):
    def run(self, start: FittedModel | None, *, rounds: int = _MOST_ROUNDS) -> FittedModel:
        """Find the model: add components, move them, prune them."""
        model = None if start is None else self.refit(start)
        if model is None:
            gains = _STARTING_GAINS if self.free_gain else (self.rules.gain or 1.0,)
            model = likeliest(partial(self._begin, gain) for gain in gains)
        model = self._add_announced(self.prune(model))
        for _ in range(rounds):
            better = self._extend(model, self._find_excesses(model)) or self._move_line(model)
            if better is None:
                break
            model = better
        return self._restore_turbulence(self.prune(self.drop_roll_off(model)))

    def _begin(self, gain: float) -> FittedModel:
        """Fit the background and the first lines at a sensor gain."""
        ground = self._fit_background(gain)
        found = self._find_excesses(ground)
        clear = [c for c in found if c.gain > max(2 * self.price, 0.02 * found[0].gain)]
        return self.fit(*self._add_candidates(ground, clear))

    def _fit_background(self, gain: float) -> FittedModel:
        """Fit turbulence and noise to medians over bands, which lines hardly touch."""
        data = self.data
        f, d, weight = smooth_background(data.power(gain), data.frequency_hz, data.count)
        zero = np.zeros_like(f)
        smooth = Likelihood(
            replace(data, frequency_hz=f, measured=d, crossed=zero, corrected=zero, count=weight)
        )
        white = float(np.median(d[f >= 0.6 * f[-1]])) * data.frame_rate_hz / 2
        total = float(np.sum(np.diff(f) * (d[1:] + d[:-1]) / 2))
        slow = max(total - white, 0.1 * white)
        parts = (Part(line=False),)

        def fit_from(frequency_hz: float) -> FittedModel:
            theta = np.array(
                [
                    np.log(gain),
                    np.log(white),
                    self.layout.starting_corner(),
                    np.log(frequency_hz * self.layout.angle),
                    np.log(0.5),
                    np.log(slow),
                ]
            )
            free = np.ones(theta.size, dtype=bool)
            free[GAIN] = False
            priors = self.layout.priors(theta, parts)
            return FittedModel(minimum=minimise(smooth, theta, priors, free=free), parts=parts)

        return likeliest(partial(fit_from, f_hz) for f_hz in _STARTING_FREQUENCIES_HZ)

    def _add_candidates(
        self, model: FittedModel, found: list[Candidate]
    ) -> tuple[FloatArray, tuple[Part, ...]]:
        """Return parameters and parts with candidates added."""
        theta, parts = [model.theta], list(model.parts)
        for c in found:
            line = c.frequency_hz >= self.rules.lowest_line_hz
            damping = np.clip(c.half_width_hz / c.frequency_hz, 1e-4, 0.3) if line else 0.3
            theta.append(self.layout.new_component(c.frequency_hz, float(damping), c.variance_nm2))
            parts.append(Part(line=line))
        whole = np.concatenate(theta)
        for i in range(len(model.parts), len(parts)):
            whole = self.centre_line(whole, i)
        return whole, tuple(parts)

    def _add_announced(self, model: FittedModel) -> FittedModel:
        """Return the model with those announced lines that add enough.

        A line of the model within three errors of an announced one is taken for it.
        """
        if not self.rules.announced:
            return model
        step, angle = self.layout.step, self.layout.angle
        theta, parts = [model.theta], list(model.parts)
        density = self.full.model(model.theta)
        for f, error in self.rules.announced:
            known = (float(np.log(f * angle)), max(error, 0.1 * step) / f)
            near = [
                i
                for i, part in enumerate(model.parts)
                if part.line
                and abs(self.layout.place(model.theta, i)[0] - f) < 3 * max(error, step)
            ]
            if near:
                parts[near[0]] = Part(line=True, frequency=known)
                continue
            level = float(np.interp(f, self.data.frequency_hz, density))
            theta.append(self.layout.new_component(f, 0.01, level * max(0.01 * f, step)))
            parts.append(Part(line=True, frequency=known))
        made = self.try_fit(np.concatenate(theta), tuple(parts))
        return model if made is None else self.prune(made)

    def _find_excesses(self, model: FittedModel) -> list[Candidate]:
        """Find bands with too much power, as many as there may be more lines."""
        room = self._room(model)
        if room <= 0:
            return []
        power = self.data.power(float(np.exp(model.theta[GAIN])))
        density = self.full.model(model.theta)
        found = find_candidates(self.data, power, density, least=self.price, most=room)
        if sum(not part.line for part in model.parts) >= _MOST_TURBULENCES:
            found = [c for c in found if c.frequency_hz >= self.rules.lowest_line_hz]
        return found

    def _room(self, model: FittedModel) -> int:
        """Return how many more lines there may be."""
        return self.rules.most_lines - sum(part.line for part in model.parts)

    def _extend(self, model: FittedModel, found: list[Candidate]) -> FittedModel | None:
        """Return the model with the best candidates, those that pay; None if none does."""
        found = [c for c in found if c.gain > 0.25 * found[0].gain]
        while found:
            made = self.try_fit(*self._add_candidates(model, found))
            if made is not None:
                made = self.prune(made)
                if self.cost(made) < self.cost(model):
                    return made
            found = found[: len(found) // 2]
        return None

    def _restore_turbulence(self, model: FittedModel) -> FittedModel:
        """Make a slow component the turbulence, where a resonance took its place."""
        theta, lowest = model.theta, self.rules.lowest_line_hz * self.layout.angle
        frequencies = [np.exp(component(theta, i)[FREQUENCY]) for i in range(len(model.parts))]
        slow = [i for i, f in enumerate(frequencies) if i and f < lowest]
        ratio = damping_ratio(component(theta, 0)[DAMPING], first=True)
        if frequencies[0] < lowest or not slow or has_corner(theta) or ratio > 0.98:
            return model
        i = strongest(theta, slow)
        swapped = promote_component(theta, i)
        component(swapped, i)[:] = component(theta, 0)
        component(swapped, i)[DAMPING] = damping_parameter(ratio, first=False)
        parts = (*model.parts[:i], Part(line=True), *model.parts[i + 1 :])
        made = self.try_fit(swapped, parts)
        if made is not None and self.cost(made) < self.cost(model) + self.price:
            return made
        return model

    def _move_line(self, model: FittedModel) -> FittedModel | None:
        """Return the model with a line moved, or split in two; None if none is better."""
        for i, part in enumerate(model.parts):
            for trial in self._line_moves(model, i) if part.line else ():
                made = self.try_fit(*trial)
                if made is not None:
                    made = self.prune(made)
                    if self.cost(made) < self.cost(model) - 1:
                        return made
        return None

    def _line_moves(self, model: FittedModel, i: int) -> list[tuple[FloatArray, tuple[Part, ...]]]:
        """Return other beginnings for a line: elsewhere in its band, or as two lines."""
        data, theta, step = self.data, model.theta, self.layout.step
        centre, half = self.layout.place(theta, i)
        reach = max(10 * half, 20 * step)
        start, stop = np.searchsorted(data.frequency_hz, [centre - reach, centre + reach])
        rest = self.full.model(remove_component(theta, i))
        power = data.power(float(np.exp(theta[GAIN])))
        seen = measure_excess(data, power, rest, int(start), int(stop))
        moves = []
        centred = self.centre_line(theta, i)
        moved_by = component(centred, i)[FREQUENCY] - component(theta, i)[FREQUENCY]
        if abs(moved_by) * centre > 0.4 * step:
            moves.append((centred, model.parts))
        if abs(seen.frequency_hz - centre) > 0.5 * half + step:
            damping = min(seen.half_width_hz / seen.frequency_hz, 0.5)
            again = theta.copy()
            component(again, i)[:] = self.layout.new_component(
                seen.frequency_hz, damping, seen.variance_nm2
            )
            moves.append((again, model.parts))
        if half > 3 * step and self._room(model) > 0:
            pair = component(theta, i) + np.log(
                [[1 - half / centre, 0.5, 0.5], [1 + half / centre, 0.5, 0.5]]
            )
            split = np.concatenate([theta, pair[1]])
            component(split, i)[:] = pair[0]
            moves.append((split, (*model.parts, Part(line=True))))
        return moves
