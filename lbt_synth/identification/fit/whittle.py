"""Whittle's likelihood of a spectrum of resonances over white noise, in a running loop.

For a periodogram I(g) of n values and a spectrum S(theta)::

    L(theta, g) = sum count (log S + I(g) / S) + sum ((theta - centre) / width)^2 / 2

is minus the logarithm of the likelihood (P. Whittle, Ark. Mat. 2, 423 (1953),
doi:10.1007/BF02590998) and of the priors. The measurement is ``y(k) = z(k) - g c(k)``, z of
spectrum S, and c(k) follows from y up to k-1: the change of variables from z to y has a unit
Jacobian, so the likelihood of what the closed loop recorded is that of ``z = y + g c``. The
sensor gain g is one more parameter, which only the data depend on.

Everything is in units of the measurement: a component's variance is g^2 times that of the phase.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain
from typing import Any, Literal

import numpy as np

from lbt_synth.identification.fit.periodogram import FAR, WIDE, LoopPeriodogram, log_smearing
from lbt_synth.models.resonance_spectrum import log_density, log_roll_off
from lbt_synth.validation import FloatArray, IntArray

GAIN = 0  # place of the sensor gain in a packed vector
WIDE_DAMPING = 0.1  # damping ratio of a resonance that is no line
NO_CORNER = 50.0  # angle per frame; a corner above it is none
_TILT_ORDER = 5 / 6  # of its roll-off: tilt falls with f^(-17/3), a second-order process with f^-4
_LEAST = 0.05  # damping ratio of turbulence; narrower components are lines
_JUST_ABOVE = 1e-3

Kind = Literal["turbulence", "slow", "line"]  # "slow": another part of the turbulence


@dataclass(frozen=True, slots=True)
class Component:
    """A resonance, by the numbers that a fit varies.

    The damping ratio zeta of the turbulence is above 0.05, that of all others below 1: their
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
        return float(np.exp(self.log_frequency))

    @property
    def damping_ratio(self) -> float:
        """Damping ratio."""
        if self.kind == "turbulence":
            return float(_LEAST + np.exp(self.damping))
        return float(1 / (1 + np.exp(-self.damping)))

    @property
    def damping_slope(self) -> float:
        """Derivative of the logarithm of the damping ratio by ``damping``."""
        ratio = self.damping_ratio
        return 1 - _LEAST / ratio if self.kind == "turbulence" else 1 - ratio

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
    if kind == "turbulence":
        return float(np.log(max(ratio - _LEAST, _JUST_ABOVE)))
    return float(np.log(ratio / (1 - ratio)))


@dataclass(frozen=True, slots=True)
class SpectrumModel:
    """White noise and resonances; the first component is the turbulence behind its roll-off.

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
        return bool(self.log_corner < np.log(NO_CORNER))

    def keep(self, wanted: Callable[[Component], bool]) -> SpectrumModel:
        """Return the model with the turbulence and those of the other components."""
        first, *others = self.components
        return replace(self, components=(first, *filter(wanted, others)))

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

    def drop_wide(self, most: float) -> SpectrumModel:
        """Return the model without lines of a larger damping ratio."""
        return self.keep(lambda c: c.kind != "line" or c.damping_ratio <= most)


_DIFFERENCE = 1e-4  # of a logarithm
_FARTHEST = 60.0  # of a logarithm: exp stays finite
_LEAST_INFORMATION = 1e-6  # of a parameter: a step is finite where the data say nothing
_OPTIONS: dict[str, Any] = {
    "maxiter": 40,
    "gtol": 1e-3,
    "initial_trust_radius": 1.0,
    "max_trust_radius": 8.0,
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Priors:
    """Normal priors on the packed parameters: a width of infinity is none, 0 fixes one."""

    centre: FloatArray  # (p,): means
    width: FloatArray  # (p,): standard deviations

    @property
    def free(self) -> IntArray:
        """Places of the parameters that a fit varies."""
        return np.flatnonzero(self.width > 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedModel:
    """A minimum of the likelihood."""

    spectrum: SpectrumModel
    contrast: float  # L without the priors
    information: FloatArray  # (p, p): second derivatives of L; 0 for what was fixed
    evidence: tuple[float, ...] = ()  # what each component adds to the log-likelihood


def densities(
    data: LoopPeriodogram, spectrum: SpectrumModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the densities of noise and components, (1 + c, f), with log derivatives.

    The derivatives by frequency and damping are (c, 2, f), those of the noise by its colour and of
    the turbulence by its corner (2, f).
    """
    s, white = data.half_angle_square, 2 / data.frame_rate_hz
    count = len(spectrum.components)
    density, slopes = np.empty((1 + count, s.size)), np.empty((count, 2, s.size))
    shape, by_colour = _log_colour(spectrum.colour, s)
    density[0] = white * np.exp(spectrum.log_noise + shape)
    fall, by_corner = log_roll_off(float(np.exp(spectrum.log_corner)), spectrum.roll_off_order, s)
    for c, own, slope in zip(spectrum.components, density[1:], slopes, strict=True):
        value, slope[0], slope[1] = log_density(c.frequency, c.damping_ratio, s)
        if c.kind == "turbulence":
            value = value + fall
        else:
            _smear(data, c, value, slope)
        slope[1] *= c.damping_slope
        np.exp(value + (c.log_power + np.log(white)), out=own)
    return density, slopes, np.array([by_colour, by_corner])


def _log_colour(colour: float, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the spectrum of first-order noise over that of white noise, and its slope, (f,)."""
    a = np.tanh(colour)
    below = (1 - a) ** 2 + a * s
    return np.log1p(-(a**2)) - np.log(below), -2 * a + (1 - a**2) * (2 * (1 - a) - s) / below


def _smear(data: LoopPeriodogram, line: Component, value: FloatArray, slope: FloatArray) -> None:
    """Let the taper smear a narrow line, in place; ``slope`` is by log f and log damping."""
    if data.duration_s is None:
        return
    centre = line.frequency * data.frame_rate_hz / (2 * np.pi)
    half_width = line.damping_ratio * centre * data.duration_s
    if half_width > WIDE:
        return
    reach = FAR / data.duration_s
    start, stop = np.searchsorted(data.frequency_hz, [centre - reach, centre + reach])
    distance = (data.frequency_hz[start:stop] - centre) * data.duration_s
    more, by_width, by_distance = log_smearing(half_width, distance)
    value[start:stop] += more
    slope[0, start:stop] += by_width - by_distance * centre * data.duration_s
    slope[1, start:stop] += by_width


def density(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the density of the whole spectrum, (f,)."""
    return np.asarray(densities(data, spectrum)[0].sum(axis=0))


def contrast(data: LoopPeriodogram, spectrum: SpectrumModel) -> float:
    """Return L without the priors."""
    model = density(data, spectrum)
    power = data.power(spectrum.gain)
    return float(np.sum(data.count * (np.log(model) + power / model)))


def log_slopes(
    each: FloatArray, slopes: FloatArray, by_shape: FloatArray, model: FloatArray
) -> FloatArray:
    """Return the slopes of a spectrum, by all parameters, over a density (f,), (p, f).

    The first three arguments are those of :func:`densities`. The gain changes the data, not the
    spectrum.
    """
    noise = each[0] / model
    rows = [np.zeros_like(model), noise, by_shape[0] * noise, by_shape[1] * each[1] / model]
    for own, (by_frequency, by_damping) in zip(each[1:], slopes, strict=True):
        share = own / model
        rows += [by_frequency * share, by_damping * share, share]
    return np.array(rows)


def derivatives(
    data: LoopPeriodogram, spectrum: SpectrumModel
) -> tuple[float, FloatArray, FloatArray]:
    """Return L without the priors, its gradient (p,) and its information matrix (p, p)."""
    count, gain = data.count, spectrum.gain
    each, slopes, by_shape = densities(data, spectrum)
    model = each.sum(axis=0)
    ratio = data.power(gain) / model
    rows = log_slopes(each, slopes, by_shape, model)
    weighted = rows * count
    gradient = weighted @ (1 - ratio)
    information = weighted @ rows.T
    # the gain changes the data, not the model
    cross, square = 2 * gain * data.crossed, 2 * gain**2 * data.corrected
    by_gain = (cross + square) / model
    gradient[GAIN] = np.sum(count * by_gain)
    information[GAIN] = information[:, GAIN] = -weighted @ by_gain
    information[GAIN, GAIN] = np.sum(count * (cross + 2 * square) / model)
    return float(np.sum(count * (np.log(model) + ratio))), gradient, information


def scoring_minimum(
    differentiate: Callable[[FloatArray], tuple[float, FloatArray, FloatArray]],
    start: FloatArray,
    priors: Priors,
) -> tuple[FloatArray, FloatArray] | None:
    """Minimise a contrast of the free parameters and their priors by scoring in a trust region.

    ``differentiate`` returns the contrast, its gradient and its information matrix. Return the
    parameters (free,) and the information (free, free); None if the contrast is not finite.
    """
    from scipy.optimize import minimize

    free = priors.free
    centre, precision = priors.centre[free], 1 / priors.width[free] ** 2

    @lru_cache(maxsize=1)  # scipy asks for value, gradient and Hessian one after the other
    def evaluate(raw: bytes) -> tuple[float, FloatArray, FloatArray]:
        x = np.clip(np.frombuffer(raw), -_FARTHEST, _FARTHEST)
        value, gradient, information = differentiate(x)
        away = x - centre
        return (
            value + 0.5 * float(np.sum(precision * away**2)),
            gradient + precision * away,
            information + np.diag(precision + _LEAST_INFORMATION),
        )

    try:
        found = minimize(  # type: ignore[call-overload]
            lambda x: evaluate(x.tobytes())[0],
            start,
            jac=lambda x: evaluate(x.tobytes())[1],
            hess=lambda x: evaluate(x.tobytes())[2],
            method="trust-exact",
            options=_OPTIONS,
        )
    except OverflowError:  # a step of the trust region that is not finite
        return None
    _, gradient, reduced = evaluate(found.x.tobytes())
    # what a Newton step would still gain
    left = 0.5 * float(gradient @ np.linalg.lstsq(reduced, gradient, rcond=None)[0])
    if not (np.isfinite(found.fun) and np.isfinite(left)):
        return None
    return found.x, reduced


def minimise(data: LoopPeriodogram, start: SpectrumModel, priors: Priors) -> FittedModel | None:
    """Minimise L by scoring in a trust region; None if L is not finite."""
    free, theta = priors.free, start.pack()

    def differentiate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        theta[free] = x
        value, gradient, information = derivatives(data, start.unpack(theta))
        return value, gradient[free], information[np.ix_(free, free)]

    found = scoring_minimum(differentiate, theta[free], priors)
    if found is None:
        return None
    theta[free], reduced = found
    spectrum = start.unpack(theta)
    information = np.zeros((theta.size, theta.size))
    information[np.ix_(free, free)] = reduced
    return FittedModel(
        spectrum=spectrum, contrast=contrast(data, spectrum), information=information
    )


def observe_information(data: LoopPeriodogram, model: FittedModel, priors: Priors) -> FittedModel:
    """Return a minimum with the exact second derivatives of L, by differences of its gradient.

    Where they are not positive definite, the expected ones stay.
    """
    free, theta = priors.free, model.spectrum.pack()

    def gradient(change: FloatArray) -> FloatArray:
        return derivatives(data, model.spectrum.unpack(theta + change))[1][free]

    steps = _DIFFERENCE * np.eye(theta.size)[free]
    exact = np.array([gradient(step) - gradient(-step) for step in steps]) / (2 * _DIFFERENCE)
    exact = (exact + exact.T) / 2 + np.diag(1 / priors.width[free] ** 2)
    if np.min(np.linalg.eigvalsh(exact)) <= 0:
        return model
    information = np.zeros_like(model.information)
    information[np.ix_(free, free)] = exact
    return replace(model, information=information)


def invert_information(information: FloatArray) -> FloatArray:
    """Return the covariance of parameters, (p, p); 0 for those without information."""
    moves = np.flatnonzero(np.diag(information) > 0)
    block = information[np.ix_(moves, moves)]
    scale = 1 / np.sqrt(np.diag(block))
    both = np.outer(scale, scale)
    out = np.zeros_like(information)
    out[np.ix_(moves, moves)] = np.linalg.pinv(block * both, hermitian=True) * both
    return out
