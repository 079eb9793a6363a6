"""Spectra of resonances over white noise, by the parameters that a fit varies.

Each axis has its own noise and components; two axes may share resonances as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain, pairwise
from typing import Literal

import numpy as np

from lbt_synth.models.resonance_spectrum import PARAMETERS, WIDE_DAMPING
from lbt_synth.validation import FloatArray

GAIN, NOISE, COLOUR, CORNER, COMPONENTS = range(5)  # where they begin in a packed vector
SHARED = PARAMETERS + 2  # parameters of a resonance of two axes: ratio and phase are the last
_NO_CORNER = 50.0  # angle per frame; a corner above it is none
_TILT_ORDER = 5 / 6  # of its roll-off: tilt falls with f^(-17/3), a second-order process with f^-4
_LEAST = 0.05  # damping ratio of turbulence; narrower components are lines
_JUST_ABOVE = 1e-3
_NOTHING = float(np.log(np.finfo(float).tiny))  # as a logarithm

# "slow" is another part of the turbulence; a "drift" of first order, whose damping
# ratio is held far above 1, stands in the place of the first
Kind = Literal["turbulence", "drift", "slow", "line"]
_FIRST: tuple[Kind, ...] = ("turbulence", "drift")


@dataclass(frozen=True, slots=True)
class Component:
    """A resonance, by the numbers that a fit varies.

    The damping ratio zeta of the first one is above 0.05, that of all others below 1: their
    ``damping`` is ``log(zeta - 0.05)`` and ``log(zeta / (1 - zeta))``. One that two axes share has
    the cross-spectrum ``sqrt(S1 S2) e^(i phase)``, and its power is that on the first axis: with a
    phase of 0 or pi it moves along a line, with any other on an ellipse.
    """

    kind: Kind
    log_frequency: float  # of the natural frequency, an angle per frame
    damping: float
    log_power: float  # of the variance, in units of the measurement
    announced: tuple[float, float] | None = None  # log_frequency known beforehand, and its error
    name: int = 0  # by which a search for what axes share finds it again
    log_ratio: float = 0.0  # of its variance on the second axis over that on the first
    phase: float = 0.0  # by which the first axis is ahead
    before: tuple[Component | None, Component | None] = (None, None)  # what it has replaced
    holds_ratio: bool = False  # whether the ratio is not fitted

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

    def on(self, axis: int) -> Component:
        """Return what one axis shows of a component that two share."""
        power = self.log_power + axis * self.log_ratio
        return Component(self.kind, self.log_frequency, self.damping, power, self.announced)

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
        each = (
            Component(c.kind, f, damping, power, c.announced, c.name)
            for c, f, damping, power in rows
        )
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
        return replace(self, log_corner=float(np.log(2 * _NO_CORNER))) if self.rolls_off else self

    def without_colour(self) -> SpectrumModel:
        """Return the model with white noise."""
        return replace(self, colour=0.0)

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


@dataclass(frozen=True, slots=True)
class Spectra:
    """The spectra of one or two axes, and the resonances that two share."""

    axes: tuple[SpectrumModel, ...]
    shared: tuple[Component, ...] = ()

    @property
    def starts(self) -> list[int]:
        """Where the parameters of each axis begin in the vector, and those of shared ones."""
        sizes = (COMPONENTS + PARAMETERS * len(axis.components) for axis in self.axes)
        return list(accumulate(sizes, initial=0))

    @property
    def gains(self) -> FloatArray:
        """The sensor gain of each axis, (axes,)."""
        return np.array([axis.gain for axis in self.axes])

    @property
    def lines(self) -> tuple[Component, ...]:
        """The components of all axes that are lines."""
        parts = chain(self.shared, *(axis.components for axis in self.axes))
        return tuple(c for c in parts if c.kind == "line")

    def whole(self, i: int) -> SpectrumModel:
        """Return the spectrum of an axis, with its part of shared resonances at the end."""
        return self.axes[i].add(*(resonance.on(i) for resonance in self.shared))

    def axis_map(self, i: int) -> FloatArray:
        """Return the derivatives of an axis' whole parameters (a,) by all parameters (p,)."""
        start, stop = self.starts[i : i + 2]
        count, first = len(self.shared), self.starts[-1]
        out = np.zeros((stop - start + PARAMETERS * count, first + SHARED * count))
        out[: stop - start, start:stop] = np.eye(stop - start)
        for k in range(count):
            row, column = stop - start + PARAMETERS * k, first + SHARED * k
            out[row : row + PARAMETERS, column : column + PARAMETERS] = np.eye(PARAMETERS)
            out[row + PARAMETERS - 1, column + PARAMETERS] = i  # the ratio of a second axis
        return out

    def pack(self) -> FloatArray:
        """Return the parameters of all axes, and of what they share, as a vector (p,)."""
        shared = [
            [c.log_frequency, c.damping, c.log_power, c.log_ratio, c.phase] for c in self.shared
        ]
        return np.concatenate([*(axis.pack() for axis in self.axes), *shared])

    def unpack(self, vector: FloatArray) -> Spectra:
        """Return the model with the numbers of a vector (p,)."""
        ends = pairwise(self.starts)
        axes = tuple(axis.unpack(vector[a:b]) for axis, (a, b) in zip(self.axes, ends, strict=True))
        rows = vector[self.starts[-1] :].reshape(-1, SHARED).tolist()
        shared = tuple(
            replace(c, log_frequency=f, damping=ratio, log_power=power, log_ratio=rise, phase=phase)
            for c, (f, ratio, power, rise, phase) in zip(self.shared, rows, strict=True)
        )
        return Spectra(axes, shared)

    def on_axis(self, i: int, model: SpectrumModel) -> Spectra:
        """Return the spectra with another one of an axis, beside what is shared."""
        return replace(self, axes=(*self.axes[:i], model, *self.axes[i + 1 :]))

    def release(self, k: int, *parts: Component | None) -> Spectra:
        """Return the spectra with a component on each axis, or none, for shared resonance k."""
        axes = tuple(
            axis if part is None else axis.add(part)
            for axis, part in zip(self.axes, parts or (None,) * len(self.axes), strict=True)
        )
        return Spectra(axes, self.shared[:k] + self.shared[k + 1 :])
