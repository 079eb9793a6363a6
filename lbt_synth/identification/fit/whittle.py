"""Whittle's likelihood of spectra of resonances over white noise, in a running loop.

For the periodograms I(g) of one or two axes, (n, n) and Hermitian at each frequency, and their
spectrum S(theta)::

    L(theta, g) = sum count (log det S + tr(S^-1 I(g))) + sum ((theta - centre) / width)^2 / 2

is minus the logarithm of the likelihood (P. Whittle, Ark. Mat. 2, 423 (1953),
doi:10.1007/BF02590998) and of the priors. The measurement is ``y(k) = z(k) - g c(k)``, z of
spectrum S, and c(k) follows from y up to k-1: the change of variables from z to y has a unit
Jacobian, so the likelihood of what the closed loop recorded is that of ``z = y + g c``. The
sensor gain g is one more parameter, which only the data depend on.

Everything is in units of the measurement: a component's variance is g^2 times that of the phase.

The taper of a periodogram smears lines that are narrower than the record can show. The expected
periodogram of a line of half width g and distance d from its centre, both in units of the inverse
of the segment's duration, is the Lorentzian smeared by the taper h::

    K(g, d) = int e^(-2 pi g |t|) R(t) e^(-2 pi i d t) dt,   R the autocorrelation of h

It is tabulated once. (The same correction for any process is A. M. Sykulski et al., Biometrika
106, 251 (2019), doi:10.1093/biomet/asy071.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from lbt_synth.identification.fit.periodogram import LoopPeriodogram, tukey
from lbt_synth.identification.fit.scoring import EXACT, Priors, scoring_minimum
from lbt_synth.identification.fit.spectrum_model import (
    CORNER,
    GAIN,
    SHARED,
    Component,
    Spectra,
    SpectrumModel,
)
from lbt_synth.models.resonance_spectrum import (
    PARAMETERS,
    log_roll_off,
    resonance_densities,
    unit_density,
)
from lbt_synth.validation import ComplexArray, FloatArray

DIFFERENCE = 1e-4  # of a logarithm
WIDE = 30.0  # half width above which a line is not smeared
_FAR = 400.0  # distance beyond which no line is smeared
_NOTHING = 0.003  # change of the logarithm of a line that is neglected
_NARROWEST = 1e-9
_WIDTHS = 72
_LOBES = 64.0  # distance up to which single lobes are resolved
_STEP = 0.1
_VALLEY = 0.003  # of the mean over a lobe, the least between lobes
_GROWTH = 1.03  # of the steps beyond, where lobes are averaged
_SAMPLES = 4096  # of the taper

Model = SpectrumModel | Spectra


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedModel:
    """A minimum of the likelihood."""

    spectra: Spectra
    contrast: float  # L without the priors
    information: FloatArray  # (p, p): second derivatives of L; 0 for what was fixed
    evidence: tuple[float, ...] = ()  # what each component adds to the log-likelihood

    @property
    def spectrum(self) -> SpectrumModel:
        """The spectrum of the first axis, the only one of most fits."""
        return self.spectra.axes[0]

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the packed parameters, the inverse of the information, (p, p)."""
        return invert_information(self.information)

    def with_spectrum(self, spectrum: SpectrumModel) -> FittedModel:
        """Return the fit with another spectrum of its only axis."""
        return replace(self, spectra=Spectra((spectrum,)))


@lru_cache(maxsize=1)
def _table() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return knots of log g (w,), a grid of distances (d,), and log K between both.

    The last has the coefficients of polynomials in two variables, cubic in the part of a step of
    the grid and in log g beyond its knot, the highest power of the latter first:
    (4, 4, w - 1, d - 1).
    """
    h = tukey(_SAMPLES)
    transform = np.fft.rfft(h, 2 * _SAMPLES)
    correlation = np.fft.irfft(np.abs(transform) ** 2)[:_SAMPLES]
    correlation /= correlation[0]
    t = np.arange(_SAMPLES) / _SAMPLES
    widths = np.geomspace(_NARROWEST, 1.2 * WIDE, _WIDTHS)
    places = np.arange(0, _LOBES + _STEP / 2, _STEP).tolist()
    while places[-1] < 1.05 * _FAR:
        places.append(places[-1] + _GROWTH * (places[-1] - places[-2]))
    grid = np.array(places)
    decaying = 2 / _SAMPLES * correlation * np.exp(-2 * np.pi * np.outer(widths, t))
    decaying[:, 0] /= 2
    waves = np.cos(2 * np.pi * np.outer(t, grid))
    at, mean = decaying @ waves, (decaying * np.sinc(t)) @ waves  # the mean over a lobe
    # of the taper itself, not of its samples
    at, mean = (each * np.sinc(grid / _SAMPLES) ** 2 for each in (at, mean))
    at = np.maximum(at, _VALLEY * mean)  # no fit crosses the zeros between lobes
    blend = np.clip((grid - _LOBES / 2) / (_LOBES / 2), 0, 1)
    k = np.maximum(at * (1 - blend) + mean * blend, 1e-14)
    knots = np.log(widths)
    value = CubicSpline(knots, np.log(k)).c  # (4, w, d)
    slope = np.asarray(np.gradient(value, axis=2))
    rise, (m0, m1) = np.diff(value, axis=2), (slope[..., :-1], slope[..., 1:])
    powers = [value[..., :-1], m0, 3 * rise - 2 * m0 - m1, m0 + m1 - 2 * rise]
    return knots, grid, np.stack(powers, axis=1)


@lru_cache(maxsize=1)
def _reaches() -> FloatArray:
    """Return beyond which distance a line of each tabulated width is hardly changed, (w,)."""
    knots, grid, table = _table()
    g, distance = np.exp(knots)[:-1, None], grid[:-1]
    change = table[-1, 0] + np.log(np.pi / g * (g**2 + distance**2))
    last = np.max(np.where(np.abs(change) > _NOTHING, grid[1:], 0.0), axis=1)
    return np.maximum.accumulate(last[::-1])[::-1]


def smearing_reach(half_width: FloatArray) -> FloatArray:
    """Return the distance beyond which lines are hardly changed, (n,)."""
    knots, *_ = _table()
    row = np.searchsorted(knots, np.log(np.maximum(half_width, _NARROWEST)), side="right") - 1
    return _reaches()[np.minimum(row, knots.size - 2)]


def log_smearing(
    half_width: FloatArray | float, distance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the logarithm of the ratio of smeared lines to the lines themselves, (f,).

    The half width is one for all, or (f,) as the distance. The derivatives by the logarithm of the
    width and by the distance follow.
    """
    knots, grid, table = _table()
    g, size = np.broadcast_to(half_width, distance.shape), np.abs(distance)
    log_width = np.log(np.maximum(g, _NARROWEST))
    row = np.minimum(np.searchsorted(knots, log_width, side="right") - 1, knots.size - 2)
    w = log_width - knots[row]
    left = np.minimum(np.searchsorted(grid, size, side="right") - 1, grid.size - 2)
    step = grid[left + 1] - grid[left]
    x = (size - grid[left]) / step
    c3, c2, c1, c0 = table.reshape(4, 4, -1).take(row * (grid.size - 1) + left, axis=2)
    y0, y1, y2, y3 = ((c3 * w + c2) * w + c1) * w + c0
    v0, v1, v2, v3 = ((3 * c3 * w + 2 * c2) * w + c1) * (g > _NARROWEST)
    square = g**2 + distance**2
    return (
        y0 + x * (y1 + x * (y2 + x * y3)) + np.log(np.pi / g * square),
        v0 + x * (v1 + x * (v2 + x * v3)) + (2 * g**2 / square - 1),
        (y1 + x * (2 * y2 + 3 * x * y3)) / step * np.sign(distance) + 2 * distance / square,
    )


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
    fall, by_corner = _log_tilt(data, spectrum.log_corner, spectrum.roll_off_order)
    rolling = [i for i, c in enumerate(components, 1) if c.kind == spectrum.rolling]
    density[rolling] *= np.exp(fall)
    _smear(data, components, density[1:], slopes)
    slopes[:, 1] *= slope[:, None]
    by_shape = np.array([by_colour * density[0], by_corner * density[rolling].sum(axis=0)])
    return density, slopes, by_shape


def _log_tilt(
    data: LoopPeriodogram, log_corner: float, order: float
) -> tuple[FloatArray, FloatArray]:
    """Return the roll-off of turbulence as frames show it, a logarithm, and its slope, (f,).

    The mean over a frame takes ``sinc^2`` of the phase. A process of finite order is one of means.
    """
    fall, slope = log_roll_off(float(np.exp(log_corner)), order, data.half_angle_square)
    return fall if order == 1 else fall + data.log_frame_mean, slope


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


@lru_cache(maxsize=64)
def component_density(
    data: LoopPeriodogram, component: Component, roll_off: tuple[float, float] | None = None
) -> FloatArray:
    """Return the density of a component behind a roll-off of a corner and an order, (f,)."""
    s, c = data.half_angle_square, component
    own = unit_density(c.frequency, c.damping_ratio, s)
    if roll_off is not None:
        own *= np.exp(_log_tilt(data, *roll_off)[0])
    _smear(data, [c], own[None])
    return np.asarray(2 / data.frame_rate_hz * np.exp(c.log_power) * own)


def part_density(
    data: LoopPeriodogram, spectrum: SpectrumModel, component: Component
) -> FloatArray:
    """Return the density of a component of a spectrum, (f,)."""
    roll_off = (spectrum.log_corner, spectrum.roll_off_order)
    rolls = component.kind == spectrum.rolling
    return component_density(data, component, roll_off if rolls else None)


def density(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the density of the whole spectrum of one axis, (f,)."""
    shape, _ = _log_colour(spectrum.colour, data.half_angle_square)
    total = np.asarray(2 / data.frame_rate_hz * np.exp(spectrum.log_noise + shape))
    for c in spectrum.components:
        total += part_density(data, spectrum, c)
    return total


def _crossed(model: Spectra, parts: Sequence[tuple[FloatArray, ...]]) -> tuple[ComplexArray, ...]:
    """Return what shared resonances add to S12, (f,) each, from their parts on either axis."""
    each = zip(model.shared, *parts, strict=True)
    return tuple(np.exp(1j * c.phase) * np.sqrt(one * other) for c, one, other in each)


def joint_density(
    data: LoopPeriodogram, model: Spectra
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Return the densities S11, S22 and S12 of two axes, (f,) each."""
    wholes = [model.whole(i) for i in range(2)]
    shares = [
        tuple(part_density(data, axis, c) for c in axis.components[len(own.components) :])
        for axis, own in zip(wholes, model.axes, strict=True)
    ]
    first, second = (density(data, axis) for axis in wholes)
    nothing = np.zeros(first.size, dtype=np.complex128)
    return first, second, np.asarray(sum(_crossed(model, shares), nothing))


def contrast(data: LoopPeriodogram, model: Model, held: FloatArray | float = 0.0) -> float:
    """Return L without the priors; ``held`` (f,) is a density beside that of one axis."""
    if isinstance(model, SpectrumModel):
        return float(contrasts(data, model.gain, held + density(data, model)))
    if len(model.axes) == 1:
        return contrast(data, model.axes[0], held)
    first, second, crossed = joint_density(data, model)
    determinant = first * second - np.abs(crossed) ** 2
    left, right = data.power(model.gains[:, None])
    seen, _ = data.cross_power(model.gains.tolist())
    trace = second * left + first * right - 2 * (crossed.conj() * seen).real
    return float(np.sum(data.count * (np.log(determinant) + trace / determinant)))


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
    data: LoopPeriodogram, model: Model, held: FloatArray | float = 0.0
) -> tuple[float, FloatArray, FloatArray]:
    """Return L without the priors, its gradient (p,) and its information matrix (p, p).

    ``held`` (f,) is a density beside that of one axis. The rows of sensor gains are exact second
    derivatives; there are none by the gains of two axes.
    """
    spectra = Spectra((model,)) if isinstance(model, SpectrumModel) else model
    axes = len(spectra.axes)
    both = _two_axes(data, spectra) if axes > 1 else _one_axis(data, spectra.axes[0], held)
    rows, log_determinant, seen, by_gain, bend = both
    count = data.count if axes == 1 else np.tile(data.count, 4)
    trace = axes * data.count.size  # the values of the diagonal come first
    root, rest = np.sqrt(count), -seen
    rest[:trace] += 1
    gradient, information = rows @ (root * rest), rows @ rows.T
    # the gains change the data, not the model
    for start, slope in zip(spectra.starts, by_gain, strict=False):
        gradient[start + GAIN] = count[:trace] @ slope[:trace]
        between = -(rows @ (root * slope))
        information[start + GAIN] = information[:, start + GAIN] = between
        information[start + GAIN, start + GAIN] = bend
    value = data.count @ log_determinant + count[:trace] @ seen[:trace]
    return float(value), gradient, information


_Whitened = tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]


def _one_axis(
    data: LoopPeriodogram, spectrum: SpectrumModel, held: FloatArray | float
) -> _Whitened:
    """Return weighted slopes (p, f), log S, data over S, its slope by the gain, and the bend."""
    each, slopes, by_shape = densities(data, spectrum)
    model = held + each.sum(axis=0)
    rows = log_slopes(each, slopes, by_shape, model / np.sqrt(data.count))
    slope, bend = data.power_slopes(spectrum.gain)
    curvature = float(np.sum(data.count * bend / model))
    return rows, np.log(model), data.power(spectrum.gain) / model, (slope / model)[None], curvature


def _two_axes(data: LoopPeriodogram, model: Spectra) -> _Whitened:
    """Return the same of two axes, ``C^-1 M C^-H`` for each matrix M and S = C C^H.

    Such a matrix is (..., 4 f), so that products of rows are traces of products.
    """
    bins, starts, count = data.count.size, model.starts, len(model.shared)
    size = starts[-1] + SHARED * count
    straight = np.zeros((2, size, bins))  # slopes of S11 and S22 by all parameters
    crossed = np.zeros((size, bins), dtype=np.complex128)  # and of S12
    parts, slopes = [], []
    for i in range(2):
        each, by_part, by_shape = densities(data, model.whole(i))
        rows, own = log_slopes(each, by_part, by_shape, np.ones(bins)), starts[i + 1] - starts[i]
        straight[i, starts[i] : starts[i + 1]] = rows[:own]
        slopes.append(rows[own:].reshape(count, PARAMETERS, bins))
        parts.append(each)
    shares = [tuple(each[each.shape[0] - count :]) for each in parts]
    crosses = _crossed(model, shares)
    for k, cross in enumerate(crosses):
        at = starts[-1] + SHARED * k
        ratio, phase = at + PARAMETERS, at + PARAMETERS + 1
        straight[:, at:ratio] = slopes[0][k], slopes[1][k]
        straight[1, ratio] = shares[1][k]
        logs = sum(own[k] / share[k] for own, share in zip(slopes, shares, strict=True))
        crossed[at:ratio], crossed[ratio] = 0.5 * cross * logs, 0.5 * cross
        crossed[phase] = 1j * cross
        for start, axis in zip(starts, model.axes, strict=False):
            if model.shared[k].kind == axis.rolling:
                corner = float(np.exp(axis.log_corner))
                fall = log_roll_off(corner, axis.roll_off_order, data.half_angle_square)[1]
                crossed[start + CORNER] += 0.5 * cross * fall
    first, second = (each.sum(axis=0) for each in parts)
    cross = np.asarray(sum(crosses, np.zeros(bins, dtype=np.complex128)))
    determinant = first * second - np.abs(cross) ** 2
    v, w = -cross.conj() / np.sqrt(first * determinant), np.sqrt(first / determinant)

    def whiten(a: FloatArray, b: FloatArray, c: ComplexArray) -> FloatArray:
        corner = (a * v.conj() + c * w) * np.sqrt(2 / first)
        last = np.abs(v) ** 2 * a + 2 * w * (v * c).real + w**2 * b
        return np.concatenate([a / first, last, corner.real, corner.imag], axis=-1)

    left, right = data.power(model.gains[:, None])
    seen, by_gains = data.cross_power(model.gains.tolist())
    own_slopes, _ = data.power_slopes(model.gains[:, None])
    first_gain, second_gain = own_slopes * np.eye(2)[:, :, None]
    by_gain = whiten(first_gain, second_gain, by_gains)
    rows = whiten(straight[0], straight[1], crossed) * np.tile(np.sqrt(data.count), 4)
    return rows, np.log(determinant), whiten(left, right, seen), by_gain, 0.0


def minimise(
    data: LoopPeriodogram,
    start: Model,
    priors: Priors,
    *,
    held: FloatArray | float = 0.0,
    bound: float = float("inf"),
    accuracy: float = EXACT,
) -> FittedModel | None:
    """Minimise L by scoring in a trust region, to an accuracy.

    ``held`` (f,) is a density beside that of one axis. Return None if L is not finite, or will
    hardly fall below a bound.
    """
    spectra = Spectra((start,)) if isinstance(start, SpectrumModel) else start
    free, theta = priors.free, spectra.pack()

    def differentiate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        theta[free] = x
        value, gradient, information = derivatives(data, spectra.unpack(theta), held)
        return value, gradient[free], information[np.ix_(free, free)]

    least = scoring_minimum(differentiate, theta[free], priors, bound=bound, accuracy=accuracy)
    if least is None:
        return None
    theta[free], reduced = least
    made = spectra.unpack(theta)
    information = np.zeros((theta.size, theta.size))
    information[np.ix_(free, free)] = reduced
    return FittedModel(spectra=made, contrast=contrast(data, made, held), information=information)


def observe_information(data: LoopPeriodogram, model: FittedModel, priors: Priors) -> FittedModel:
    """Return a minimum with the second derivatives of L, by differences of its gradient.

    Where they are not positive definite, the expected ones stay.
    """
    free, theta = priors.free, model.spectra.pack()
    _, gradient, _ = derivatives(data, model.spectra)
    rows = []
    for step in DIFFERENCE * np.eye(theta.size)[free]:
        moved = derivatives(data, model.spectra.unpack(theta + step))[1]
        rows.append((moved - gradient)[free] / DIFFERENCE)
    exact = (np.array(rows) + np.transpose(rows)) / 2 + np.diag(1 / priors.width[free] ** 2)
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
