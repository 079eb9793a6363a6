"""Whittle's likelihood of spectra of resonances over noise, in a running loop.

For the periodograms I(g) of n axes, (n, n) and symmetric at each frequency, and their spectrum
S(theta)::

    L(theta, g) = sum count (log det S + tr(S^-1 I(g))) + sum ((theta - centre) / width)^2 / 2

is minus the logarithm of the likelihood (P. Whittle, Ark. Mat. 2, 423 (1953),
doi:10.1007/BF02590998) and of the priors. The measurement is ``y(k) = z(k) - g c(k)``, z of
spectrum S, and c(k) follows from y up to k-1: the change of variables from z to y has a unit
Jacobian, so the likelihood of what the closed loop recorded is that of ``z = y + g c``. The
sensor gain g is one more parameter, which only the data depend on.

With ``W S W^T = 1``, each slope of S by a parameter becomes ``W (dS/dtheta) W^T``, and the
gradient and the expected information are sums of products of these.

Everything is in units of the measurement: a component's variance is g^2 times that of the phase.

The taper of a periodogram smears lines that are narrower than the record can show. The expected
periodogram of a line of half width g and distance d from its centre, both in units of the inverse
of the segment's duration, is the Lorentzian smeared by the taper h::

    K(g, d) = int e^(-2 pi g |t|) R(t) e^(-2 pi i d t) dt,   R the autocorrelation of h

The taper is a rectangle of width ``1 - e`` folded with half a cosine of width e, its edge. R is
then made of lines and cosines, and K is twice the real part of its Laplace transform at
``p = 2 pi (g + i d)``. (The same correction for any process is A. M. Sykulski et al., Biometrika
106, 251 (2019), doi:10.1093/biomet/asy071.)

Minima are found by scoring: Newton's method with the expected information. Each step is the best
one of the quadratic form within a trust region (J. Nocedal, S. Wright, Numerical Optimization, 2nd
ed. (2006), section 4.3). What the full step would gain, half the gradient's square in the metric of
the inverse information, says how far the minimum is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dposv

from lbt_synth.identification.fit.periodogram import TAPER, LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import (
    BACKGROUND,
    COLOUR,
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
    unit_densities,
)
from lbt_synth.validation import FloatArray, IntArray

DIFFERENCE = 1e-4  # of a logarithm: the step of a numerical derivative
WIDE = 30.0  # half width [periods] above which smearing changes a line by less than 0.2 %
SKIRT = 64  # distance [periods] beyond which a sinusoid leaves less than 4e-9 of its peak
_NARROWEST = 1e-5  # half width [periods]: below, a line is a sinusoid, and p^-2 would be rounding
SEARCHED, EXACT = 1e-2, 1e-5  # log-likelihood that a step may still gain where a fit ends
_FARTHEST = 60.0  # of a logarithm: exp stays finite
_LEAST_INFORMATION = 1e-6  # of a parameter: a step is finite where the data say nothing
_RADIUS, _LARGEST_RADIUS = 1.0, 8.0  # of the trust region
MOST_STEPS = 40
_ACCEPTED, _POOR, _GOOD = 0.15, 0.25, 0.75  # of what a step should gain
_ALONG = 1e-4  # cosine below which a secant says nothing
_WITHIN = 0.99  # of the radius: a longer step ends at it
HOPE = 4.0  # times what is seen before a fit, it may still gain


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedModel:
    """A minimum of the likelihood."""

    spectrum: SpectrumModel
    contrast: float  # L without the priors
    information: FloatArray  # (p, p): second derivatives of L; 0 for what was fixed
    evidence: tuple[float, ...] = ()  # what each component adds to the log-likelihood

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the packed parameters, the inverse of the information, (p, p)."""
        return invert_information(self.information)

    @cached_property
    def errors(self) -> SpectrumModel:
        """Standard error of each parameter."""
        return self.spectrum.unpack(np.sqrt(np.maximum(np.diag(self.covariance), 0)))


def log_smearing(
    half_width: FloatArray | float, distance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the logarithm of the ratio of a smeared line to the line itself, (f,).

    The derivatives by the logarithm of the half width and by the distance follow.
    """
    e, b = TAPER / 2, 2 * np.pi / TAPER
    p = 2 * np.pi * (np.maximum(half_width, _NARROWEST) + 1j * distance)
    r, s, edge, end = 1 / p, 1 / (p**2 + b**2), np.exp(-e * p), np.exp((2 * e - 1) * p)
    lobes, weight = end * (1 + edge) ** 2 - 2 * edge, (b**2 * r * s) ** 2
    transform = (4 - 6 * e - 2 * r) * r + (e * p + 2 + 2 * b**2 * s) * s + weight * lobes
    by_lobes = 2 * e * edge - end * (1 + edge) * (1 - 2 * e + edge)
    slope = (4 * r + 6 * e - 4) * r**2 + (e - 2 * p * s * (e * p + 2 + 4 * b**2 * s)) * s
    slope += weight * (by_lobes - 2 * lobes * (r + 2 * p * s))
    g, square = half_width, half_width**2 + distance**2
    bend = 2 * np.pi * slope / transform.real
    return (
        np.log(transform.real / (2 - 2.5 * e) * np.pi / g * square),
        g * bend.real * (g > _NARROWEST) + (2 * g**2 / square - 1),
        2 * distance / square - bend.imag,
    )


def _noise_density(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the density of the noise of each axis, a first-order process, (n, f)."""
    s, white = data.half_angle_square, 2 / data.frame_rate_hz
    rows = []
    for axis in spectrum.axes:
        a = np.tanh(axis.colour)
        power = 2 * (np.log(2) - np.logaddexp(axis.colour, -axis.colour))  # log of 1 - a^2
        rows.append(white * np.exp(axis.log_noise + power) / ((1 - a) ** 2 + a * s))
    return np.array(rows)


def _smear(
    data: LoopPeriodogram,
    components: Sequence[Component],
    density: FloatArray,
    slopes: FloatArray | None = None,
) -> None:
    """Smear narrow lines by the taper: in place, densities (c, f) and log slopes (c, 2, f)."""
    if data.duration_s is None:
        return
    periods, lines = data.frequency_hz * data.duration_s, []
    for i, c in enumerate(components):
        place = c.frequency / data.angle_s * data.duration_s
        half_width = c.damping_ratio * place
        if c.kind == "line" and c.sections == 1 and half_width <= WIDE:
            band = slice(*np.searchsorted(periods, [place - SKIRT, place + SKIRT]))
            lines.append((i, band, place, half_width, periods[band] - place))
    if not lines:
        return
    sizes = [line[4].size for line in lines]
    widths = np.repeat([line[3] for line in lines], sizes)
    smeared = np.array(log_smearing(widths, np.concatenate([line[4] for line in lines])))
    for (i, band, place, *_), rows in zip(
        lines, np.split(smeared, np.cumsum(sizes)[:-1], axis=1), strict=True
    ):
        density[i, band] *= np.exp(rows[0])
        if slopes is not None:
            slopes[i, 0, band] += rows[1] - rows[2] * place
            slopes[i, 1, band] += rows[1]


def _log_fall(
    data: LoopPeriodogram, spectrum: SpectrumModel, turbulence: Component
) -> tuple[FloatArray, FloatArray]:
    """Return the roll-off of turbulence as frames show it, a logarithm, and its slope, (f,)."""
    corner = float(np.exp(spectrum.axes[turbulence.axis or 0].log_corner))
    fall, slope = log_roll_off(corner, spectrum.roll_off_order, data.half_angle_square)
    # a frame shows the mean of the phase; a process of finite order is one of means
    return fall if spectrum.roll_off_order == 1 else fall + data.log_frame_mean, slope


def part_densities(
    data: LoopPeriodogram, spectrum: SpectrumModel, components: Sequence[Component] | None = None
) -> FloatArray:
    """Return the densities (c, f) of components along their directions: of all, or of others."""
    components = spectrum.components if components is None else components
    if not components:
        return np.zeros((0, data.frequency_hz.size))
    places = [(c.frequency, c.damping_ratio, c.sections, c.log_power) for c in components]
    frequency, ratio, sections, log_power = zip(*places, strict=True)
    density = unit_densities(frequency, ratio, data.half_angle_square, sections)
    density *= 2 / data.frame_rate_hz * np.exp(log_power)[:, None]
    for row, component in zip(density, components, strict=True):
        if component.kind == "turbulence":
            row *= np.exp(_log_fall(data, spectrum, component)[0])
    _smear(data, components, density)
    return density


def density(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the density of the spectrum of one axis, (f,)."""
    parts = part_densities(data, spectrum)
    return np.asarray(_noise_density(data, spectrum)[0] + np.sum(parts, axis=0))


def spectral_matrix(data: LoopPeriodogram, spectrum: SpectrumModel) -> FloatArray:
    """Return the spectrum of n axes, (n, n, f)."""
    matrix = np.eye(len(spectrum.axes))[:, :, None] * _noise_density(data, spectrum)
    for a, part in zip(spectrum.directions, part_densities(data, spectrum), strict=True):
        matrix += np.multiply.outer(np.outer(a, a), part)
    return matrix


def contrast(
    data: LoopPeriodogram, spectrum: SpectrumModel, held: FloatArray | float = 0.0
) -> float:
    """Return L without the priors; ``held`` (f,) is a density beside that of one axis."""
    if len(spectrum.axes) == 1:
        return float(contrasts(data, spectrum.background.gain, held + density(data, spectrum)))
    whitening, log_determinant = _whiten(spectral_matrix(data, spectrum))
    seen = np.einsum("ikf,klf,ilf->f", whitening, data.matrix(spectrum.gains), whitening)
    return float(np.sum(data.count * (log_determinant + seen)))


def contrasts(data: LoopPeriodogram, gain: float, model: FloatArray) -> FloatArray:
    """Return L without the priors of densities (..., f) of one axis, for one sensor gain."""
    return np.asarray(np.sum(data.count * (np.log(model) + data.power(gain) / model), axis=-1))


def _whiten(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return W with ``W S W^T = 1`` of one axis or two, (n, n, f), and log det S, (f,)."""
    inverse, log_determinant = np.zeros_like(matrix), np.log(matrix[0, 0])
    inverse[0, 0] = 1 / np.sqrt(matrix[0, 0])
    if len(matrix) > 1:
        below = matrix[1, 0] * inverse[0, 0]
        rest = matrix[1, 1] - below**2
        inverse[1, 1] = 1 / np.sqrt(rest)
        inverse[1, 0] = -below * inverse[0, 0] * inverse[1, 1]
        log_determinant += np.log(rest)
    return inverse, log_determinant


def _vector(matrices: FloatArray) -> FloatArray:
    """Return matrices (..., n, n, f) as vectors (..., m, f), whose products are their traces."""
    if matrices.shape[-2] == 1:
        return np.asarray(matrices[..., 0, :, :])
    between = np.sqrt(0.5) * (matrices[..., 0, 1, :] + matrices[..., 1, 0, :])
    return np.stack([matrices[..., 0, 0, :], between, matrices[..., 1, 1, :]], axis=-2)


def _outer(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the outer products of (..., n, f), as vectors (..., m, f)."""
    return _vector(one[..., :, None, :] * other[..., None, :, :])


def densities(
    data: LoopPeriodogram, spectrum: SpectrumModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the density of each component along its direction, (c, f), and its slopes.

    The slopes of its logarithm by frequency and damping are (c, 2, f); those of the turbulence
    by its corner (c, f), 0 for all others.
    """
    s, components = data.half_angle_square, spectrum.components
    rows = [(c.frequency, c.damping_ratio, c.damping_slope, c.log_power) for c in components]
    frequency, ratio, slope, power = np.array(rows).reshape(-1, 4).T
    variance = 2 / data.frame_rate_hz * np.exp(power)
    sections = [c.sections for c in components]
    density, slopes = resonance_densities(frequency, ratio, variance, s, sections)
    by_corner = np.zeros_like(density)
    for i, component in enumerate(components):
        if component.kind == "turbulence":
            fall, by_corner[i] = _log_fall(data, spectrum, component)
            density[i] *= np.exp(fall)
    _smear(data, components, density, slopes)
    slopes[:, 1] *= slope[:, None]
    return density, slopes, by_corner


def derivatives(
    data: LoopPeriodogram, spectrum: SpectrumModel, held: FloatArray | float = 0.0
) -> tuple[float, FloatArray, FloatArray]:
    """Return L without the priors, its gradient (p,) and its information matrix (p, p).

    ``held`` (f,) is a density beside that of one axis. The row of its sensor gain is of exact
    second derivatives; there are none by the gains of two axes.
    """
    n, start, root = len(spectrum.axes), spectrum.place(0), np.sqrt(data.count)
    s = data.half_angle_square
    parts, slopes, by_corner = densities(data, spectrum)
    noise, directions = _noise_density(data, spectrum), spectrum.directions
    matrix = np.eye(n)[:, :, None] * (noise + held)
    matrix += np.tensordot(directions[:, :, None] * directions[:, None], parts, (0, 0))
    whitening, log_determinant = _whiten(matrix)
    # each slope of S, whitened
    along = np.einsum("ijf,cj->cif", whitening, directions)
    weights = _outer(along, along) * parts[:, None]
    rows = np.zeros((spectrum.place(len(parts)), *weights.shape[1:]))
    for i, axis in enumerate(spectrum.axes):
        at, unit, a = BACKGROUND * i, whitening[:, i], np.tanh(axis.colour)
        rows[at + NOISE] = noise[i] * _outer(unit, unit)
        by_colour = -2 * a + (1 - a**2) * (2 * (1 - a) - s) / ((1 - a) ** 2 + a * s)
        rows[at + COLOUR] = rows[at + NOISE] * by_colour
    for k, component in enumerate(spectrum.components):
        if component.kind == "turbulence":
            rows[BACKGROUND * (component.axis or 0) + CORNER] = by_corner[k] * weights[k]
    components = rows[start:].reshape(len(parts), spectrum.width, *weights.shape[1:])
    np.multiply(slopes[:, :, None], weights[:, None], out=components[:, :2])
    components[:, 2] = weights
    for k in spectrum.shared:  # the ratio turns the direction
        turned = np.einsum("ijf,j->if", whitening, directions[k] * [0.0, 1.0])
        components[k, PARAMETERS] = _outer(along[k], turned) * parts[k]

    seen = np.einsum("ikf,klf,jlf->ijf", whitening, data.matrix(spectrum.gains), whitening)
    measured, unit = _vector(seen), _vector(np.eye(n)[:, :, None])
    rows *= root
    flat = rows.reshape(len(rows), -1)
    gradient, information = flat @ (root * (unit - measured)).ravel(), flat @ flat.T
    value = data.count @ (log_determinant + unit.T @ measured)[0]
    if n == 1:  # the gain changes the data, not the model
        gain = spectrum.background.gain
        by_gain = 2 * gain * (data.crossed + gain * data.corrected) / matrix[0, 0]
        bend = by_gain + 2 * gain**2 * data.corrected / matrix[0, 0]
        gradient[GAIN], information[GAIN, GAIN] = data.count @ by_gain, data.count @ bend
        information[GAIN, 1:] = information[1:, GAIN] = -(flat[1:] @ (root * by_gain))
    return float(value), gradient, information


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Priors:
    """Normal priors on the packed parameters: a width of infinity is none, 0 fixes one."""

    centre: FloatArray  # (p,): means
    width: FloatArray  # (p,): standard deviations
    bounds: tuple[FloatArray | float, FloatArray | float] = (-_FARTHEST, _FARTHEST)  # (p,) each

    @property
    def free(self) -> IntArray:
        """Places of the parameters that a fit varies."""
        return np.flatnonzero(self.width > 0)


def scoring_minimum(
    differentiate: Callable[[FloatArray], tuple[float, FloatArray, FloatArray]],
    start: FloatArray,
    priors: Priors,
    *,
    bound: float = float("inf"),
    accuracy: float = EXACT,
) -> tuple[FloatArray, FloatArray] | None:
    """Minimise a contrast of the free parameters and their priors, within bounds.

    ``differentiate`` returns the contrast, its gradient and its information matrix. Return the
    parameters (free,) and the information (free, free); None if the contrast is not finite, or
    where it is unlikely to fall below ``bound``.
    """
    free = priors.free
    centre, precision = priors.centre[free], 1 / priors.width[free] ** 2
    low, high = (np.broadcast_to(ends, priors.width.shape)[free] for ends in priors.bounds)

    def evaluate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        value, gradient, information = differentiate(x)
        away = x - centre
        return (
            value + 0.5 * float(np.sum(precision * away**2)),
            gradient + precision * away,
            information + np.diag(precision + _LEAST_INFORMATION),
        )

    x, radius = np.clip(start, low, high), _RADIUS
    value, gradient, information = evaluate(x)
    rest = np.zeros_like(information)  # of the second derivatives
    for _ in range(MOST_STEPS):
        if not (np.isfinite(value) and np.all(np.isfinite(information))):
            return None
        curvature, slope = information + rest, gradient
        stays = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))  # at a bound
        if np.any(stays):
            curvature[stays] = curvature[:, stays] = 0
            curvature[stays, stays], slope = 1, np.where(stays, 0, slope)
        step, gain, expected = _best_step(curvature, slope, radius)
        if gain < accuracy:
            break
        size = float(np.linalg.norm(step))
        if value - HOPE * gain > bound and size < _WITHIN * radius:
            return None  # a whole step, which can be trusted
        trial = np.clip(x + step, low, high)
        made = evaluate(trial)
        if np.isfinite(made[0]):
            between = 0.5 * (information + made[2])
            rest = rest + _secant(made[1] - gradient - (between + rest) @ (trial - x), trial - x)
        gained = (value - made[0]) / expected
        if not gained > _POOR:
            radius = 0.25 * min(radius, size)
        elif gained > _GOOD and size > _WITHIN * radius:
            radius = min(2 * radius, _LARGEST_RADIUS)
        if gained > _ACCEPTED:
            x, (value, gradient, information) = trial, made
    return x, information


def _best_step(
    curvature: FloatArray, gradient: FloatArray, radius: float
) -> tuple[FloatArray, float, float]:
    """Return the best step (p,) within a radius, and the gains of a full step and of this one."""
    newton, info = dposv(curvature, -gradient)[1:]
    if info == 0 and float(np.linalg.norm(newton)) <= radius:
        gain = -0.5 * float(gradient @ newton)
        return newton, gain, gain
    size, axes = np.linalg.eigh(curvature)
    size, slope = np.maximum(np.abs(size), _LEAST_INFORMATION), gradient @ axes
    step = _trust_step(slope, size, radius)
    gain = 0.5 * float(np.sum(slope**2 / size))
    return axes @ step, gain, -float(slope @ step + 0.5 * step @ (size * step))


def _secant(missing: FloatArray, step: FloatArray) -> FloatArray:
    """Return the symmetric rank-one matrix that maps a step to ``missing``; 0 if nearly normal."""
    along = float(missing @ step)
    least = _ALONG * float(np.linalg.norm(missing) * np.linalg.norm(step))
    return np.outer(missing, missing) / along if abs(along) > least else np.zeros((step.size,) * 2)


def _trust_step(slope: FloatArray, curvature: FloatArray, radius: float) -> FloatArray:
    """Return the step (p,) to the minimum of a quadratic form within a radius, in its axes."""
    shift = 0.0
    for _ in range(MOST_STEPS):
        step = -slope / (curvature + shift)
        length = float(np.linalg.norm(step))
        if length <= 1.001 * radius:
            break
        # Newton's method for 1 / size = 1 / radius, from below
        shift += length**2 / float(np.sum(step**2 / (curvature + shift))) * (length / radius - 1)
    return step


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

    ``held`` (f,) is a density beside that of one axis. Return None if L is not finite, or will
    hardly fall below a bound.
    """
    free, theta = priors.free, start.pack()

    def differentiate(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        theta[free] = x
        value, gradient, information = derivatives(data, start.unpack(theta), held)
        return value, gradient[free], information[np.ix_(free, free)]

    least = scoring_minimum(differentiate, theta[free], priors, bound=bound, accuracy=accuracy)
    if least is None:
        return None
    theta[free], reduced = least
    spectrum = start.unpack(theta)
    information = np.zeros((theta.size, theta.size))
    information[np.ix_(free, free)] = reduced
    value = contrast(data, spectrum, held)
    return FittedModel(spectrum=spectrum, contrast=value, information=information)


def observe_information(data: LoopPeriodogram, model: FittedModel, priors: Priors) -> FittedModel:
    """Return a minimum with the second derivatives of L, by differences of its gradient."""
    free, theta = priors.free, model.spectrum.pack()
    _, gradient, _ = derivatives(data, model.spectrum)
    rows = []
    for step in DIFFERENCE * np.eye(theta.size)[free]:
        moved = derivatives(data, model.spectrum.unpack(theta + step))[1]
        rows.append((moved - gradient)[free] / DIFFERENCE)
    exact = (np.array(rows) + np.transpose(rows)) / 2 + np.diag(1 / priors.width[free] ** 2)
    if np.min(np.linalg.eigvalsh(exact)) <= 0:  # no minimum: the expected ones stay
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
