"""Fits of given components to one periodogram, and what each component must add to stay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.errors import NumericalError
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
    FREQUENCY,
    GAIN,
    Likelihood,
    add_observed_information,
    component,
    minimise,
)
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import BoolArray, FloatArray

_ANNOUNCED = 5.0  # log-likelihood that a line of known frequency must add
_SPLIT = 9.0  # the same of the second of two lines that lie in each other's skirts
_HIGHEST = float(np.log(0.999 * np.pi))  # angle per frame of a line
_SHIFTS = np.arange(-2, 2.01, 0.25)  # bins by which a narrow line is moved
_POWERS = (0.0, float(np.log(4)), float(-np.log(4)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rules:
    """What the search may do."""

    gain: float | None  # sensor gain; None to find it
    lowest_line_hz: float  # below, a component belongs to the turbulence [Hz]
    most_lines: int
    announced: Sequence[tuple[float, float]] = ()  # (frequency, error) of known lines [Hz]


class ModelFitter:
    """Fit components to one periodogram, and drop those that add too little."""

    def __init__(self, data: LoopPeriodogram, rules: Rules) -> None:
        self.data, self.rules = data, rules
        self.full = Likelihood(data)
        self.layout = Layout(data)
        self.price = self.layout.price
        self.free_gain = rules.gain is None and data.closed

    def fit(self, theta: FloatArray, parts: tuple[Part, ...]) -> FittedModel:
        """Fit all parameters; drop components that leave the band below the Nyquist frequency."""
        merged = Likelihood(self.data.merge(self.layout.groups(theta, parts)))
        priors = self.layout.priors(theta, parts)
        found = minimise(merged, theta, priors, free=self._free(theta))
        left, stay = found.parameters, list(parts)
        for i in reversed(range(1, len(parts))):
            if component(found.parameters, i)[FREQUENCY] >= _HIGHEST:
                left = remove_component(left, i)
                del stay[i]
        if len(stay) < len(parts):
            return self.fit(left, tuple(stay))
        found = replace(found, contrast=self.full.contrast(found.parameters))
        return FittedModel(minimum=found, parts=parts)

    def try_fit(self, theta: FloatArray, parts: tuple[Part, ...]) -> FittedModel | None:
        """Fit as :meth:`fit` does; None if the fit does not settle."""
        try:
            return self.fit(theta, parts)
        except NumericalError:
            return None

    def refit(self, start: FittedModel) -> FittedModel | None:
        """Fit a model of other data to these; None if it does not settle."""
        theta = start.theta.copy()
        if not self.free_gain:
            theta[GAIN] = np.log(self.rules.gain or 1.0)
        if not has_corner(theta):
            theta[CORNER] = self.layout.starting_corner()
        return self.try_fit(theta, start.parts)

    def drop_roll_off(self, model: FittedModel) -> FittedModel:
        """Return the model without the roll-off of its turbulence, if that adds too little."""
        if not has_corner(model.theta):
            return model
        theta = model.theta.copy()
        theta[CORNER] = np.log(2 * NO_CORNER)
        less = self.try_fit(theta, model.parts)
        if less is not None and less.contrast - model.contrast < self.price / PARAMETERS:
            return less
        return model

    def prune(self, model: FittedModel) -> FittedModel:
        """Drop the components that add less than they must, the least first."""
        while len(model.parts) > 1:
            trials = []
            for i in range(len(model.parts)):
                less = drop_part(model, i)
                if less is None:
                    continue
                required = self.required_gain(model, i)
                spare = self.full.contrast(less[0]) - model.contrast - 4 * required
                if spare <= 0:
                    trials.append((spare, required, less))
            for _, required, less in sorted(trials, key=lambda trial: trial[0]):
                made = self.try_fit(*less)
                if made is not None and made.contrast - model.contrast < required:
                    model = made
                    break
            else:
                return model
        return model

    def required_gain(self, model: FittedModel, i: int, *, earlier: bool = False) -> float:
        """Return what a component must add to the logarithm of the likelihood.

        Less where its place was not searched for: an announced line, or one of a close pair
        (with ``earlier``, of a pair with one of the components before it).
        """
        part, theta = model.parts[i], model.theta
        if part.frequency is not None:
            return _ANNOUNCED
        if part.line:
            centre, half = self.layout.place(theta, i)
            for j, other in enumerate(model.parts[: i if earlier else None]):
                if other.line and j != i:
                    its_centre, its_half = self.layout.place(theta, j)
                    if abs(centre - its_centre) < 4 * (half + its_half):
                        return _SPLIT
        return self.price

    def cost(self, model: FittedModel) -> float:
        """Contrast of a model plus what the criterion asks for its components."""
        return model.contrast + sum(
            self.required_gain(model, i, earlier=True) for i in range(1, len(model.parts))
        )

    def add_evidence(self, model: FittedModel) -> FittedModel:
        """Return the model with what each component adds, and its exact information."""
        theta, parts = model.theta, model.parts
        less = [self.full.contrast(remove_component(theta, i)) for i in range(1, len(parts))]
        merged = Likelihood(self.data.merge(self.layout.groups(theta, parts)))
        exact = add_observed_information(
            merged, model.minimum, self.layout.priors(theta, parts), free=self._free(theta)
        )
        evidence = (float("inf"), *(value - model.contrast for value in less))
        return replace(model, minimum=exact, evidence=evidence)

    def centre_line(self, theta: FloatArray, i: int) -> FloatArray:
        """Put a line that is hardly resolved where it fits best within two bins.

        The sidelobes of the taper make as many places where a fit would stay.
        """
        step = self.layout.step
        centre, half = self.layout.place(theta, i)
        if half > 2 * step or centre <= 3 * step:
            return theta
        best, least = theta, self.full.contrast(theta)
        for shift in _SHIFTS * step:
            for power in _POWERS:
                trial = theta.copy()
                move = np.log1p(shift / centre)
                component(trial, i)[:] += (move, -move, power)  # the width stays
                if (found := self.full.contrast(trial)) < least:
                    best, least = trial, found
        return best

    def _free(self, theta: FloatArray) -> BoolArray:
        free = np.ones(theta.size, dtype=np.bool_)
        free[GAIN] = self.free_gain
        free[CORNER] = has_corner(theta)
        return free


def likeliest(fits: Iterable[Callable[[], FittedModel]]) -> FittedModel:
    """Return the likeliest of several fits; raise the last error if none of them settles."""
    best: FittedModel | None = None
    why: NumericalError | None = None
    for fit in fits:
        try:
            found = fit()
        except NumericalError as error:
            why = error
            continue
        if best is None or found.contrast < best.contrast:
            best = found
    if best is None:
        assert why is not None
        raise why
    return best
