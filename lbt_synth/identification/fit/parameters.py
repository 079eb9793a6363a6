"""The components of a model: their meaning, their priors, and the bins that they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.whittle import (
    CORNER,
    DAMPING,
    FREQUENCY,
    GAIN,
    VARIANCE,
    Minimum,
    Priors,
    component,
    component_slice,
    damping_parameter,
    damping_ratio,
)
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import FloatArray, IntArray

_GAIN_PRIOR = (np.log(0.7), 1.0)
_TURBULENCE_DAMPING = (np.log(0.45), 0.7)  # of the first component; for the others, of the odds
_PART_DAMPING = (0.0, 1.0)
_LINE_DAMPING = (np.log(0.01 / 0.99), 4.0)
_UNKNOWN_TAPER = 2.0  # width of that prior where the taper is not known
NO_CORNER = 50.0  # angle per frame; a corner above it is none
_CORNER = (np.log(50.0), 2.0)  # of its frequency [Hz]
_SLOWEST = 1.5  # width of the prior on the logarithm of a turbulence's frequency
_FINE = 0.02  # of a frequency: a smooth spectrum does not change in such a band
_WIDEST_HZ = 3.0
_BINS = 10  # on either side of a line that stay single
_SIDELOBES = 64  # the same for a line narrower than _SMEARED bins, with the taper's sidelobes
_SMEARED = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What a component of the model is."""

    line: bool  # a line, or else a part of the turbulence
    frequency: tuple[float, float] | None = None  # prior: mean and deviation of its log angle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedModel:
    """A fitted model with the meaning of its parts."""

    minimum: Minimum  # its contrast is that of all values
    parts: tuple[Part, ...]  # one per component
    evidence: tuple[float, ...] = ()  # what each component adds to the log-likelihood

    @property
    def theta(self) -> FloatArray:
        """The parameters."""
        return self.minimum.parameters

    @property
    def contrast(self) -> float:
        """Minus the logarithm of the likelihood, without the priors."""
        return self.minimum.contrast

    def drop_wide(self, most: float) -> FittedModel:
        """Return the model without lines of a larger damping ratio, without another fit."""
        theta, parts = self.theta, list(self.parts)
        for i in reversed(range(1, len(parts))):
            ratio = damping_ratio(component(self.theta, i)[DAMPING], first=False)
            if parts[i].line and ratio > most:
                theta = remove_component(theta, i)
                del parts[i]
        return replace(self, minimum=replace(self.minimum, parameters=theta), parts=tuple(parts))


def has_corner(theta: FloatArray) -> bool:
    """Whether the turbulence rolls off behind a corner."""
    return bool(theta[CORNER] < np.log(NO_CORNER))


def remove_component(theta: FloatArray, i: int) -> FloatArray:
    """Return the parameters without those of a component."""
    return np.delete(theta, component_slice(i))


def promote_component(theta: FloatArray, i: int) -> FloatArray:
    """Return the parameters with those of a component in the place of the first."""
    out = theta.copy()
    component(out, 0)[:] = component(theta, i)
    ratio = damping_ratio(component(theta, i)[DAMPING], first=False)
    component(out, 0)[DAMPING] = damping_parameter(ratio, first=True)
    return out


def strongest(theta: FloatArray, candidates: Sequence[int]) -> int:
    """Return the component of the largest variance."""
    return max(candidates, key=lambda i: float(component(theta, i)[VARIANCE]))


def drop_part(model: FittedModel, i: int) -> tuple[FloatArray, tuple[Part, ...]] | None:
    """Return parameters and parts without a component.

    Another part of the turbulence takes the place of the first; None if there is no other.
    """
    theta, parts = model.theta, model.parts
    if i == 0:
        others = [j for j, part in enumerate(parts) if j > 0 and not part.line]
        if not others:
            return None
        i = strongest(theta, others)
        theta = promote_component(theta, i)
    return remove_component(theta, i), parts[:i] + parts[i + 1 :]


class Layout:
    """How components lie on the frequencies of one periodogram."""

    def __init__(self, data: LoopPeriodogram) -> None:
        self.data = data
        self.angle = 2 * np.pi / data.frame_rate_hz
        self.step = float(np.median(np.diff(data.frequency_hz)))
        # what a component must add to the logarithm of the likelihood
        self.price = 0.5 * PARAMETERS * float(np.log(max(2.0, np.sum(data.count))))

    def place(self, theta: FloatArray, i: int) -> tuple[float, float]:
        """Return the frequency and the half width of a component [Hz], at least a bin wide."""
        frequency, damping, _ = component(theta, i)
        centre = float(np.exp(frequency)) / self.angle
        ratio = damping_ratio(damping, first=i == 0)
        return centre, max(centre * ratio, self.step)

    def new_component(self, frequency_hz: float, damping: float, variance: float) -> FloatArray:
        """Return the parameters of a component that is not the first."""
        odds = damping_parameter(damping, first=False)
        return np.array([np.log(frequency_hz * self.angle), odds, np.log(variance)])

    def starting_corner(self) -> float:
        """Return the parameter of a corner to start from."""
        return float(_CORNER[0] + np.log(self.angle))

    def priors(self, theta: FloatArray, parts: tuple[Part, ...]) -> Priors:
        """Return weak priors: what the data leave open stays where it makes sense."""
        centre, width = theta.copy(), np.full(theta.size, np.inf)
        centre[GAIN], width[GAIN] = _GAIN_PRIOR
        if has_corner(theta):
            centre[CORNER], width[CORNER] = _CORNER[0] + np.log(self.angle), _CORNER[1]
        for i, part in enumerate(parts):
            mean, deviation = component(centre, i), component(width, i)
            slow = _PART_DAMPING if i else _TURBULENCE_DAMPING
            mean[DAMPING], deviation[DAMPING] = _LINE_DAMPING if part.line else slow
            if part.line and self.data.duration_s is None:
                deviation[DAMPING] = _UNKNOWN_TAPER
            if part.frequency is not None:
                mean[FREQUENCY], deviation[FREQUENCY] = part.frequency
            elif not part.line:
                mean[FREQUENCY], deviation[FREQUENCY] = np.log(self.angle), _SLOWEST
        return Priors(centre=centre, width=width)

    def groups(self, theta: FloatArray, parts: tuple[Part, ...]) -> IntArray:
        """Return where groups of bins begin over which the model is nearly constant."""
        f = self.data.frequency_hz
        size = np.maximum(self.step, np.minimum(_FINE * f, _WIDEST_HZ))
        for i, part in enumerate(parts):
            if not part.line:
                continue
            centre, half_width = self.place(theta, i)
            fine = _SIDELOBES if half_width < _SMEARED * self.step else _BINS
            away = np.maximum(np.abs(f - centre) - fine * self.step, 0)
            np.minimum(
                size, np.maximum(self.step, 0.1 * np.maximum(half_width, 2 * away)), out=size
            )
        place = np.floor(np.cumsum(self.step / size) - 1e-9)
        return np.flatnonzero(np.concatenate([[True], np.diff(place) > 0]))
