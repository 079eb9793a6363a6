"""What the parameters of a fit mean: parts, priors, and bins that may be taken together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.whittle import (
    CORNER,
    FIRST,
    GAIN,
    Minimum,
    Priors,
    damping_parameter,
    damping_ratio,
)
from lbt_synth.models.resonance_spectrum import PARAMETERS
from lbt_synth.validation import FloatArray, IntArray

_GAIN_PRIOR = (np.log(0.7), 1.0)
_TURBULENCE_DAMPING = (np.log(0.45), 0.7)  # of the first component; of others the odds
_PART_DAMPING = (0.0, 1.0)
_LINE_DAMPING = (np.log(0.01 / 0.99), 4.0)
_UNKNOWN_TAPER = 2.0  # width of that prior where nothing tells a narrow line from a narrower one
NO_CORNER = 50.0  # angle a frame of a corner that is none
_CORNER = (np.log(50.0), 2.0)  # of its frequency [Hz]
_SLOWEST = 1.5  # width of the prior on the logarithm of a turbulence's frequency
_FINE = 0.02  # of a frequency: a smooth spectrum does not change in such a band
_WIDEST_HZ = 3.0
_BINS = 10  # on either side of a line that are not taken together
_SIDELOBES = 64  # the same of a line narrower than this many bins, with the taper's sidelobes
_SMEARED = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What a component of the model is."""

    line: bool  # Whether it is a line, or a part of the turbulence
    # (mean, deviation): prior of the logarithm of its frequency, as an angle a frame
    frequency: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedModel:
    """A fitted model with the meaning of its parts."""

    fitted: Minimum  # The minimum; its contrast is that of all values, without priors
    parts: tuple[Part, ...]  # One a component
    # What each component adds to the logarithm of the likelihood, the others refitted or not
    evidence: tuple[float, ...] = field(default=())

    @property
    def theta(self) -> FloatArray:
        """The parameters."""
        return self.fitted.parameters

    def drop_wide(self, most: float) -> FittedModel:
        """Return the model without resonances of a larger damping ratio; not fitted again."""
        theta, parts = self.theta, list(self.parts)
        for i in reversed(range(1, len(parts))):
            place = FIRST + PARAMETERS * i + 1
            if parts[i].line and damping_ratio(self.theta[place], first=False) > most:
                theta = remove_component(theta, i)
                del parts[i]
        return replace(self, fitted=replace(self.fitted, parameters=theta), parts=tuple(parts))


def has_corner(theta: FloatArray) -> bool:
    """Whether the turbulence rolls off behind a corner."""
    return bool(theta[CORNER] < np.log(NO_CORNER))


def remove_component(theta: FloatArray, i: int) -> FloatArray:
    """Parameters without a component."""
    at = FIRST + PARAMETERS * i
    return np.delete(theta, slice(at, at + PARAMETERS))


def drop_part(grown: FittedModel, i: int) -> tuple[FloatArray, tuple[Part, ...]] | None:
    """Parameters and parts without a component; another turbulence takes the place of the first.

    None if there is no other.
    """
    theta, parts = grown.theta, grown.parts
    if i > 0:
        return remove_component(theta, i), parts[:i] + parts[i + 1 :]
    others = [j for j, part in enumerate(parts) if j > 0 and not part.line]
    if not others:
        return None
    j = max(others, key=lambda j: float(theta[FIRST + PARAMETERS * j + 2]))
    at = FIRST + PARAMETERS * j
    promoted = theta.copy()
    promoted[FIRST : FIRST + PARAMETERS] = theta[at : at + PARAMETERS]
    ratio = damping_ratio(theta[at + 1], first=False)
    promoted[FIRST + 1] = damping_parameter(ratio, first=True)
    return remove_component(promoted, j), parts[:j] + parts[j + 1 :]


class Layout:
    """Frequencies and bins of one periodogram.

    Parameters
    ----------
    data : LoopPeriodogram
        The periodogram.
    """

    def __init__(self, data: LoopPeriodogram) -> None:
        self.data = data
        self.angle = 2 * np.pi / data.frame_rate_hz
        self.step = float(np.median(np.diff(data.frequency_hz)))
        # what a component must add to the logarithm of the likelihood
        self.price = 0.5 * PARAMETERS * float(np.log(max(2.0, np.sum(data.count))))

    def place(self, theta: FloatArray, i: int) -> tuple[float, float]:
        """Frequency and half width of a component [Hz], the width at least a bin."""
        at = FIRST + PARAMETERS * i
        centre = float(np.exp(theta[at])) / self.angle
        ratio = damping_ratio(theta[at + 1], first=i == 0)
        return centre, max(centre * ratio, self.step)

    def component(self, frequency_hz: float, damping: float, variance: float) -> FloatArray:
        """Parameters of a component that is not the first."""
        odds = damping_parameter(damping, first=False)
        return np.array([np.log(frequency_hz * self.angle), odds, np.log(variance)])

    def starting_corner(self) -> float:
        """Parameter of a corner to begin with."""
        return float(_CORNER[0] + np.log(self.angle))

    def priors(self, theta: FloatArray, parts: tuple[Part, ...]) -> Priors:
        """Return weak priors: what the data leave open stays where it makes sense."""
        centre, width = theta.copy(), np.full(theta.size, np.inf)
        centre[GAIN], width[GAIN] = _GAIN_PRIOR
        if has_corner(theta):
            centre[CORNER], width[CORNER] = _CORNER[0] + np.log(self.angle), _CORNER[1]
        for i, part in enumerate(parts):
            at = FIRST + PARAMETERS * i
            slow = _PART_DAMPING if i else _TURBULENCE_DAMPING
            centre[at + 1], width[at + 1] = _LINE_DAMPING if part.line else slow
            if part.line and self.data.duration_s is None:
                width[at + 1] = _UNKNOWN_TAPER
            if part.frequency is not None:
                centre[at], width[at] = part.frequency
            elif not part.line:
                centre[at], width[at] = np.log(self.angle), _SLOWEST
        return Priors(centre=centre, width=width)

    def groups(self, theta: FloatArray, parts: tuple[Part, ...]) -> IntArray:
        """Return the begin of groups of bins over which the model is nearly constant."""
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
