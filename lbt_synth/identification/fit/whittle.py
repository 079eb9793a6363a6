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

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.scoring import EXACT, Priors, scoring_minimum
from lbt_synth.identification.fit.smearing import WIDE, log_smearing, smearing_reach
from lbt_synth.identification.fit.spectrum_model import (
    COLOUR,
    COMPONENTS,
    CORNER,
    GAIN,
    NOISE,
    Component,
    SpectrumModel,
)
from lbt_synth.models.resonance_spectrum import (
    PARAMETERS,
    log_roll_off,
    resonance_densities,
    unit_density,
)
from lbt_synth.validation import FloatArray

_DIFFERENCE = 1e-4  # of a logarithm


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

    The derivatives by frequency and damping are (c, 2, f). Those of the density itself by the
    colour of the noise and the corner of the turbulence are (2, f).
    """
    s, white = data.half_angle_square, 2 / data.frame_rate_hz
    components = spectrum.components
    each = [(c.frequency, c.damping_ratio, c.damping_slope, c.log_power) for c in components]
    frequency, ratio, slope, power = np.array(each).reshape(-1, 4).T
    density = np.empty((1 + len(components), s.size))
    shape, by_colour = _log_colour(spectrum.colour, s)
    density[0] = white * np.exp(spectrum.log_noise + shape)
    density[1:], slopes = resonance_densities(frequency, ratio, white * np.exp(power), s)
    fall, by_corner = log_roll_off(float(np.exp(spectrum.log_corner)), spectrum.roll_off_order, s)
    rolling = [i for i, c in enumerate(components, 1) if c.kind == spectrum.rolling]
    density[rolling] *= np.exp(fall)
    _smear(data, components, density[1:], slopes)
    slopes[:, 1] *= slope[:, None]
    by_shape = np.array([by_colour * density[0], by_corner * density[rolling].sum(axis=0)])
    return density, slopes, by_shape


def _log_colour(colour: float, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the spectrum of first-order noise over that of white noise, and its slope, (f,)."""
    if colour == 0:
        return np.zeros_like(s), 2 - s
    a = np.tanh(colour)
    below = (1 - a) ** 2 + a * s
    power = 2 * (np.log(2) - np.logaddexp(colour, -colour))  # of a^2 from 1, as a logarithm
    return power - np.log(below), -2 * a + (1 - a**2) * (2 * (1 - a) - s) / below


def _smear(
    data: LoopPeriodogram,
    components: Sequence[Component],
    density: FloatArray,
    slopes: FloatArray | None = None,
) -> None:
    """Let the taper smear narrow lines, in place.

    The densities are (c, f), the slopes by log frequency and log damping (c, 2, f).
    """
    if data.duration_s is None:
        return
    narrow = []
    for i, c in enumerate(components):
        place = c.frequency * data.frame_rate_hz / (2 * np.pi) * data.duration_s
        if not c.is_first and c.damping_ratio * place <= WIDE:
            narrow.append((i, place, c.damping_ratio * place))
    if not narrow:
        return
    centres, half_widths = np.array(narrow).T[1:]
    at = data.periods
    reach = smearing_reach(half_widths)
    starts, stops = np.searchsorted(at, [centres - reach, centres + reach])
    inside = np.concatenate([at[a:b] for a, b in zip(starts, stops, strict=True)])
    centre, half_width = np.repeat([centres, half_widths], stops - starts, axis=1)
    more, by_width, by_distance = log_smearing(half_width, inside - centre)
    factor, by_frequency = np.exp(more), by_width - by_distance * centre
    end = 0
    for (i, *_), start, stop in zip(narrow, starts, stops, strict=True):
        part = slice(end, end := end + stop - start)
        density[i, start:stop] *= factor[part]
        if slopes is not None:
            slopes[i, 0, start:stop] += by_frequency[part]
            slopes[i, 1, start:stop] += by_width[part]


def component_densities(data: LoopPeriodogram, components: Sequence[Component]) -> FloatArray:
    """Return the densities of components but for the roll-off of turbulence, (c, f)."""
    shape = [(c.frequency, c.damping_ratio, c.log_power) for c in components]
    frequency, ratio, power = np.array(shape).reshape(-1, 3).T
    variance = 2 / data.frame_rate_hz * np.exp(power)
    own, _ = resonance_densities(frequency, ratio, variance, data.half_angle_square)
    _smear(data, components, own)
    return own


@lru_cache(maxsize=64)
def _component_density(
    data: LoopPeriodogram, component: Component, roll_off: tuple[float, float] | None
) -> FloatArray:
    """Return the density of a component behind a roll-off of a corner and an order, (f,)."""
    s, c = data.half_angle_square, component
    own = unit_density(c.frequency, c.damping_ratio, s)
    if roll_off is not None:
        corner, order = roll_off
        own *= np.exp(log_roll_off(float(np.exp(corner)), order, s)[0])
    _smear(data, [c], own[None])
    return np.asarray(2 / data.frame_rate_hz * np.exp(c.log_power) * own)


def density(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the density of the whole spectrum, (f,)."""
    shape, _ = _log_colour(spectrum.colour, data.half_angle_square)
    total = np.asarray(2 / data.frame_rate_hz * np.exp(spectrum.log_noise + shape))
    for c in spectrum.components:
        roll_off = (spectrum.log_corner, spectrum.roll_off_order)
        total += _component_density(data, c, roll_off if c.kind == spectrum.rolling else None)
    return total


def contrast(
    data: LoopPeriodogram, spectrum: SpectrumModel, held: FloatArray | float = 0.0
) -> float:
    """Return L without the priors; ``held`` (f,) is a density beside the model's."""
    return float(contrasts(data, spectrum.gain, held + density(data, spectrum)))


def contrasts(data: LoopPeriodogram, gain: float, model: FloatArray) -> FloatArray:
    """Return L without the priors of densities (..., f), for one sensor gain."""
    return np.asarray(np.sum(data.count * (np.log(model) + data.power(gain) / model), axis=-1))


def log_slopes(
    each: FloatArray, slopes: FloatArray, by_shape: FloatArray, model: FloatArray
) -> FloatArray:
    """Return the slopes of a spectrum, by all parameters, over a density (f,), (p, f).

    The first three arguments are those of :func:`densities`. The gain changes the data, not the
    spectrum.
    """
    share = each / model
    rows = np.empty((4 + PARAMETERS * len(slopes), model.size))
    rows[0] = 0
    np.divide(by_shape, model, out=rows[2:4])
    rows[1] = share[0]
    components = rows[4:].reshape(-1, PARAMETERS, model.size)
    np.multiply(slopes, share[1:, None], out=components[:, :2])
    components[:, 2] = share[1:]
    return rows


def derivatives(
    data: LoopPeriodogram, spectrum: SpectrumModel, held: FloatArray | float = 0.0
) -> tuple[float, FloatArray, FloatArray]:
    """Return L without the priors, its gradient (p,) and its information matrix (p, p).

    ``held`` (f,) is a density beside the model's.
    """
    count, gain = data.count, spectrum.gain
    each, slopes, by_shape = densities(data, spectrum)
    model = held + each.sum(axis=0)
    ratio = data.power(gain) / model
    root = np.sqrt(count)
    # weighted by how often each value counts
    rows = log_slopes(each, slopes, by_shape, model / root)
    gradient = rows @ (root * (1 - ratio))
    information = rows @ rows.T
    # the gain changes the data, not the model
    slope, bend = data.power_slopes(gain)
    by_gain = slope / model
    gradient[GAIN] = np.sum(count * by_gain)
    information[GAIN] = information[:, GAIN] = -(rows @ (root * by_gain))
    information[GAIN, GAIN] = np.sum(count * bend / model)
    return float(np.sum(count * (np.log(model) + ratio))), gradient, information


def minimise(
    data: LoopPeriodogram,
    start: SpectrumModel,
    priors: Priors,
    *,
    held: FloatArray | float = 0.0,
    bound: float = float("inf"),
    accuracy: float = EXACT,
) -> FittedModel | None:
    """Minimise L by scoring in a trust region, to an accuracy.

    ``held`` (f,) is a density beside the model's. Return None if L is not finite, or will hardly
    fall below a bound.
    """
    free, theta = priors.free, start.pack()

    def differentiate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        theta[free] = x
        value, gradient, information = derivatives(data, start.unpack(theta), held)
        return value, gradient[free], information[np.ix_(free, free)]

    found = scoring_minimum(differentiate, theta[free], priors, bound=bound, accuracy=accuracy)
    if found is None:
        return None
    theta[free], reduced = found
    spectrum = start.unpack(theta)
    information = np.zeros((theta.size, theta.size))
    information[np.ix_(free, free)] = reduced
    return FittedModel(
        spectrum=spectrum, contrast=contrast(data, spectrum, held), information=information
    )


def observe_information(data: LoopPeriodogram, model: FittedModel, priors: Priors) -> FittedModel:
    """Return a minimum with the exact second derivatives of L in place of the expected ones.

    Where they are not positive definite, the expected ones stay.
    """
    free = np.ix_(priors.free, priors.free)
    exact = second_derivatives(data, model.spectrum)[free]
    exact = exact + np.diag(1 / priors.width[priors.free] ** 2)
    if np.min(np.linalg.eigvalsh(exact)) <= 0:
        return model
    information = np.zeros_like(model.information)
    information[free] = exact
    return replace(model, information=information)


def second_derivatives(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the second derivatives of L by all parameters, (p, p), without the priors.

    Those of the spectrum are differences of its slopes. Components add, so that one difference
    serves a parameter of all of them.
    """
    theta, ones = spectrum.pack(), np.ones_like(data.frequency_hz)
    model = density(data, spectrum)
    ratio = data.power(spectrum.gain) / model
    weight = data.count * (1 - ratio) / model

    def slopes(change: FloatArray | float) -> FloatArray:
        return log_slopes(*densities(data, spectrum.unpack(theta + change)), ones)

    rows = slopes(0.0)
    out = (rows * (data.count * (2 * ratio - 1) / model**2)) @ rows.T
    slope, bend = data.power_slopes(spectrum.gain)
    out[GAIN] = out[:, GAIN] = -(rows @ (data.count * slope / model**2))
    out[GAIN, GAIN] = np.sum(data.count * bend / model)
    bends = _spectrum_bends(spectrum, rows @ weight, lambda change: slopes(change) @ weight)
    return np.asarray(out + (bends + bends.T) / 2)


def _spectrum_bends(
    spectrum: SpectrumModel, first: FloatArray, weighted: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Return weighted sums of the second derivatives of a spectrum, (p, p).

    Its slopes are given as weighted sums (p,), and so are those after a change of parameters.
    """
    parts = np.repeat(np.arange(len(spectrum.components)), PARAMETERS)
    owner = np.concatenate([[-1, -2, -2, -3], parts])  # gain, noise and colour, corner, components
    rolling = [i for i, c in enumerate(spectrum.components) if c.kind == spectrum.rolling]
    places = np.arange(owner.size)

    def difference(moved: Iterable[int]) -> FloatArray:
        step = np.where(np.isin(places, list(moved)), _DIFFERENCE, 0.0)
        return (weighted(step) - weighted(-step)) / (2 * _DIFFERENCE)

    frequencies, dampings, powers = (places[COMPONENTS + i :: PARAMETERS] for i in range(3))
    out = np.zeros((owner.size, owner.size))
    out[:, [NOISE, *powers]] = first[:, None]  # it is linear in what these are logarithms of
    for moved in ([COLOUR], frequencies, dampings):
        out[:, moved] = difference(moved)[:, None]
    out *= owner[:, None] == owner
    by_corner = difference([CORNER]) * np.isin(owner, [owner[CORNER], *rolling])
    out[CORNER], out[:, CORNER] = by_corner, by_corner
    return out


def invert_information(information: FloatArray) -> FloatArray:
    """Return the covariance of parameters, (p, p); 0 for those without information."""
    moves = np.flatnonzero(np.diag(information) > 0)
    block = information[np.ix_(moves, moves)]
    scale = 1 / np.sqrt(np.diag(block))
    both = np.outer(scale, scale)
    out = np.zeros_like(information)
    out[np.ix_(moves, moves)] = np.linalg.pinv(block * both, hermitian=True) * both
    return out
