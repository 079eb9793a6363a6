"""Spectra of resonances over noise, on one axis or on several, by the parameters that a fit varies.

The spectrum of n axes is a matrix at each frequency::

    S(f) = diag(noise(f)) + sum_k d_k(f) a_k a_k^T

with the density d_k of each component and its direction a_k over the axes: a unit vector for a
component that an axis has for itself, and ``(1, r)`` for one that two axes share, r the ratio of
their amplitudes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lbt_synth.models.resonance_spectrum import PARAMETERS, WIDE_DAMPING
from lbt_synth.validation import FloatArray

GAIN, NOISE, COLOUR, CORNER, BACKGROUND = range(5)  # places of what an axis has, their number
TILT_ORDER = 5 / 6  # of the roll-off: tilt falls with f^(-17/3), a second-order process with f^-4
_NO_CORNER = 50.0  # angle per frame; a corner above it is none
_LEAST = 0.05  # damping ratio of slow components; narrower ones are lines
_NOTHING = float(np.log(np.finfo(float).tiny))  # as a logarithm

# "turbulence" is the first component of an axis, and alone rolls off; "slow" is another part of
# it; a "drift" is of first order, with a damping ratio held far above 1
Kind = Literal["turbulence", "drift", "slow", "line"]


@dataclass(frozen=True, slots=True)
class Component:
    """A resonance, by the numbers that a fit varies.

    The damping ratio zeta of a line is below 1, that of all others above 0.05: their ``damping``
    is ``log(zeta / (1 - zeta))`` and ``log(zeta - 0.05)``. The power of one that two axes share is
    that on the first axis.
    """

    kind: Kind
    log_frequency: float  # of the natural frequency, an angle per frame
    damping: float
    log_power: float  # of the variance, in units of the measurement
    axis: int | None = 0  # None if two axes share it
    log_ratio: float = 0.0  # of its variance on the second axis over that on the first
    sign: float = 1.0  # of the ratio of the amplitudes
    name: int = 0  # by which a search for what axes share finds it again
    sections: int = 1  # resonances in series, of a bump

    @property
    def frequency(self) -> float:
        """Natural frequency, an angle per frame."""
        return math.exp(self.log_frequency)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio."""
        if self.kind == "line":
            return 1 / (1 + math.exp(-self.damping))
        return _LEAST + math.exp(self.damping)

    @property
    def is_narrow(self) -> bool:
        """Whether it is a line, not a wide resonance, a bump or a part of the turbulence."""
        return self.kind == "line" and self.sections == 1 and self.damping_ratio <= WIDE_DAMPING

    @property
    def damping_slope(self) -> float:
        """Derivative of the logarithm of the damping ratio by ``damping``."""
        ratio = self.damping_ratio
        return 1 - ratio if self.kind == "line" else 1 - _LEAST / ratio

    def direction(self, axes: int) -> FloatArray:
        """Return its direction, (axes,)."""
        if self.axis is not None:
            return np.asarray(np.eye(axes)[self.axis])
        return np.array([1.0, self.sign * math.exp(0.5 * self.log_ratio)])

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
    if kind == "line":
        return math.log(ratio / (1 - ratio))
    return math.log(max(ratio - _LEAST, 1e-3))


@dataclass(frozen=True, slots=True)
class Background:
    """What an axis has beside its components."""

    log_gain: float  # of the sensor
    log_noise: float  # of its variance
    colour: float  # of the noise: arctanh of the correlation of neighbours; 0 if it is white
    log_corner: float  # of the roll-off of the turbulence, an angle per frame

    @property
    def gain(self) -> float:
        """The sensor gain."""
        return math.exp(self.log_gain)

    @property
    def rolls_off(self) -> bool:
        """Whether the turbulence rolls off behind a corner."""
        return self.log_corner < math.log(_NO_CORNER)


@dataclass(frozen=True, slots=True)
class SpectrumModel:
    """The noise of each axis, and the components of all; the first is the turbulence of the first.

    A vector with a number for each parameter, such as standard errors, unpacks into the same
    fields.
    """

    axes: tuple[Background, ...]
    components: tuple[Component, ...]
    roll_off_order: float = TILT_ORDER  # 1 for a process of finite order

    @property
    def background(self) -> Background:
        """What the first axis has beside its components."""
        return self.axes[0]

    @property
    def gains(self) -> FloatArray:
        """The sensor gain of each axis, (axes,)."""
        return np.array([axis.gain for axis in self.axes])

    @property
    def width(self) -> int:
        """How many parameters a component has."""
        return PARAMETERS + len(self.axes) - 1

    @property
    def directions(self) -> FloatArray:
        """The direction of each component, (c, axes)."""
        rows = [component.direction(len(self.axes)) for component in self.components]
        return np.array(rows).reshape(-1, len(self.axes))

    @property
    def lines(self) -> tuple[Component, ...]:
        """The components that are lines."""
        return tuple(c for c in self.components if c.kind == "line")

    @property
    def shared(self) -> tuple[int, ...]:
        """The places of the components that two axes share."""
        return tuple(i for i, c in enumerate(self.components) if c.axis is None)

    def place(self, i: int) -> int:
        """Return where the parameters of component i begin in the vector."""
        return BACKGROUND * len(self.axes) + self.width * i

    def pack(self) -> FloatArray:
        """Return all parameters as a vector (p,)."""
        numbers: list[float] = []
        for axis in self.axes:
            numbers += (axis.log_gain, axis.log_noise, axis.colour, axis.log_corner)
        for c in self.components:
            numbers += (c.log_frequency, c.damping, c.log_power, c.log_ratio)[: self.width]
        return np.array(numbers)

    def unpack(self, vector: FloatArray) -> SpectrumModel:
        """Return the model with the numbers of a vector (p,)."""
        numbers, count = vector.tolist(), BACKGROUND * len(self.axes)
        axes = (Background(*numbers[k : k + BACKGROUND]) for k in range(0, count, BACKGROUND))
        components = []
        for i, c in enumerate(self.components):
            f, damping, power, *ratio = numbers[self.place(i) : self.place(i + 1)]
            log_ratio = ratio[0] if ratio else 0.0
            facts = c.axis, log_ratio, c.sign, c.name, c.sections
            components.append(Component(c.kind, f, damping, power, *facts))
        return SpectrumModel(tuple(axes), tuple(components), self.roll_off_order)

    def with_background(self, **changes: float) -> SpectrumModel:
        """Return the model with other noise, corner or gain of its first axis."""
        return replace(self, axes=(replace(self.axes[0], **changes), *self.axes[1:]))

    def without_roll_off(self) -> SpectrumModel:
        """Return the model with turbulence that does not roll off."""
        return self.with_background(log_corner=math.log(2 * _NO_CORNER))

    def alone(self, *wanted: Component) -> SpectrumModel:
        """Return components of one axis without the others and without noise."""
        return replace(self.with_background(log_noise=_NOTHING, colour=0.0), components=wanted)

    def add(self, *new: Component) -> SpectrumModel:
        """Return the model with more components."""
        return replace(self, components=(*self.components, *new))

    def exchange(self, i: int, *new: Component) -> SpectrumModel:
        """Return the model with others in the place of a component, or without it."""
        before, after = self.components[:i], self.components[i + 1 :]
        return replace(self, components=(*before, *new, *after))

    def on(self, i: int) -> SpectrumModel:
        """Return what axis i shows, its turbulence first, then its own components."""
        own = [replace(c, axis=0, log_ratio=0.0) for c in self.components if c.axis == i]
        own.sort(key=lambda c: c.kind != "turbulence")
        shared = [
            replace(c.shift(0.0, 0.0, i * c.log_ratio), axis=0, log_ratio=0.0, sign=1.0)
            for c in self.components
            if c.axis is None
        ]
        return SpectrumModel((self.axes[i],), (*own, *shared), self.roll_off_order)
