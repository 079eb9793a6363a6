"""A spectrum of resonances over white noise, by the parameters that a fit varies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal

import numpy as np

from lbt_synth.models.resonance_spectrum import WIDE_DAMPING
from lbt_synth.validation import FloatArray

GAIN, NOISE, COLOUR, CORNER, COMPONENTS = range(5)  # where they begin in a packed vector
_NO_CORNER = 50.0  # angle per frame; a corner above it is none
_TILT_ORDER = 5 / 6  # of its roll-off: tilt falls with f^(-17/3), a second-order process with f^-4
_LEAST = 0.05  # damping ratio of turbulence; narrower components are lines
_JUST_ABOVE = 1e-3
_NOTHING = float(np.log(np.finfo(float).tiny))  # as a logarithm

# "slow" is another part of the turbulence; a first-order "drift" stands in the place of the first
Kind = Literal["turbulence", "drift", "slow", "line"]
_FIRST: tuple[Kind, ...] = ("turbulence", "drift")


@dataclass(frozen=True, slots=True)
class Component:
    """A resonance, by the numbers that a fit varies.

    The damping ratio zeta of the first one is above 0.05, that of all others below 1: their
    ``damping`` is ``log(zeta - 0.05)`` and ``log(zeta / (1 - zeta))``.
    """

    kind: Kind
    log_frequency: float  # of the natural frequency, an angle per frame
    damping: float
    log_power: float  # of the variance, in units of the measurement
    announced: tuple[float, float] | None = None  # log_frequency known beforehand, and its error

    @property
    def frequency(self) -> float:
        """Natural frequency, an angle per frame."""
        return math.exp(self.log_frequency)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio."""
        if self.is_first:
            return _LEAST + math.exp(self.damping)
        return 1 / (1 + math.exp(-self.damping))

    @property
    def is_first(self) -> bool:
        """Whether it stands in the first place, where processes may be overdamped."""
        return self.kind in _FIRST

    @property
    def is_narrow(self) -> bool:
        """Whether it is a line, not a wide resonance or a part of the turbulence."""
        return self.kind == "line" and self.damping_ratio <= WIDE_DAMPING

    @property
    def damping_slope(self) -> float:
        """Derivative of the logarithm of the damping ratio by ``damping``."""
        ratio = self.damping_ratio
        return 1 - _LEAST / ratio if self.is_first else 1 - ratio

    def convert(self, kind: Kind) -> Component:
        """Return a component of another kind with the same spectrum, as far as it can have that."""
        ratio = self.damping_ratio
        return replace(self, kind=kind, damping=damping_parameter(kind, ratio), announced=None)

    def shift(self, log_frequency: float, damping: float, log_power: float) -> Component:
        """Return the component with its numbers changed by these."""
        return replace(
            self,
            log_frequency=self.log_frequency + log_frequency,
            damping=self.damping + damping,
            log_power=self.log_power + log_power,
        )


def damping_parameter(kind: Kind, ratio: float) -> float:
    """Return the ``damping`` of a component with a damping ratio."""
    if kind in _FIRST:
        return float(np.log(max(ratio - _LEAST, _JUST_ABOVE)))
    return float(np.log(ratio / (1 - ratio)))


@dataclass(frozen=True, slots=True)
class SpectrumModel:
    """White noise and resonances; the first component is the turbulence behind its roll-off.

    Where that place is a drift's, the slow components roll off.

    A vector with a number for each parameter, such as standard errors, unpacks into the same
    fields.
    """

    log_gain: float  # of the sensor
    log_noise: float  # of its variance
    colour: float  # of the noise: arctanh of the correlation of neighbours; 0 if it is white
    log_corner: float  # of the roll-off of the turbulence, an angle per frame
    components: tuple[Component, ...]
    roll_off_order: float = _TILT_ORDER  # 1 for a process of finite order

    def pack(self) -> FloatArray:
        """Return all parameters as a vector (p,)."""
        rows = ((c.log_frequency, c.damping, c.log_power) for c in self.components)
        first = [self.log_gain, self.log_noise, self.colour, self.log_corner]
        return np.array([*first, *chain(*rows)])

    def unpack(self, vector: FloatArray) -> SpectrumModel:
        """Return the model with the numbers of a vector (p,)."""
        gain, noise, colour, corner, *rest = vector.tolist()
        rows = zip(self.components, rest[::3], rest[1::3], rest[2::3], strict=True)
        each = (Component(c.kind, f, damping, power, c.announced) for c, f, damping, power in rows)
        return SpectrumModel(gain, noise, colour, corner, tuple(each), self.roll_off_order)

    @property
    def gain(self) -> float:
        """The sensor gain."""
        return float(np.exp(self.log_gain))

    @property
    def lines(self) -> tuple[Component, ...]:
        """The components that are lines."""
        return tuple(c for c in self.components if c.kind == "line")

    @property
    def rolls_off(self) -> bool:
        """Whether the turbulence rolls off behind a corner."""
        return bool(self.log_corner < np.log(_NO_CORNER))

    def without_roll_off(self) -> SpectrumModel:
        """Return the model with turbulence that does not roll off."""
        return replace(self, log_corner=float(np.log(2 * _NO_CORNER)))

    @property
    def rolling(self) -> Kind:
        """The kind of the components that roll off."""
        return "slow" if self.components and self.components[0].kind == "drift" else "turbulence"

    def keep(self, wanted: Callable[[Component], bool]) -> SpectrumModel:
        """Return the model with the turbulence and those of the other components."""
        first, *others = self.components
        return replace(self, components=(first, *filter(wanted, others)))

    def alone(self, *wanted: Component) -> SpectrumModel:
        """Return components without the others and without noise."""
        return replace(self, log_noise=_NOTHING, colour=0.0, components=wanted)

    def add(self, *new: Component) -> SpectrumModel:
        """Return the model with more components."""
        return replace(self, components=(*self.components, *new))

    def exchange(self, i: int, *new: Component) -> SpectrumModel:
        """Return the model with others in the place of a component, or without it."""
        before, after = self.components[:i], self.components[i + 1 :]
        return replace(self, components=(*before, *new, *after))

    def strongest(self, candidates: Sequence[int]) -> int:
        """Return the component of the largest variance among some."""
        return max(candidates, key=lambda i: self.components[i].log_power)

    def promote(self, i: int, *old: Component) -> SpectrumModel:
        """Return the model with component i as the turbulence, and another in its own place."""
        return self.exchange(0, self.components[i].convert("turbulence")).exchange(i, *old)

    def drop(self, i: int) -> SpectrumModel | None:
        """Return the model without a component; None if that is its only turbulence.

        Another part of the turbulence takes the place of the first.
        """
        if i > 0:
            return self.exchange(i)
        slow = [j for j, c in enumerate(self.components) if c.kind == "slow"]
        return self.promote(self.strongest(slow)) if slow else None
