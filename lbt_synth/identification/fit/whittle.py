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

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from lbt_synth.identification.fit.parameters import GAIN, Component, SpectrumModel
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.taper import FAR, WIDE, log_smearing
from lbt_synth.models.resonance_spectrum import log_density, log_roll_off
from lbt_synth.validation import FloatArray, IntArray

_DIFFERENCE = 1e-4  # of a logarithm
_FARTHEST = 60.0  # of a logarithm: exp stays finite
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

    The derivatives by frequency and damping are (c, 2, f), those of the turbulence by its corner
    (f,).
    """
    s, white = data.half_angle_square, 2 / data.frame_rate_hz
    count = len(spectrum.components)
    density, slopes = np.empty((1 + count, s.size)), np.empty((count, 2, s.size))
    density[0] = white * np.exp(spectrum.log_noise)
    fall, by_corner = log_roll_off(float(np.exp(spectrum.log_corner)), s)
    for c, own, slope in zip(spectrum.components, density[1:], slopes, strict=True):
        value, slope[0], slope[1] = log_density(c.frequency, c.damping_ratio, s)
        if c.kind == "turbulence":
            value = value + fall
        else:
            _smear(data, c, value, slope)
        slope[1] *= c.damping_slope
        np.exp(value + (c.log_power + np.log(white)), out=own)
    return density, slopes, by_corner


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


def derivatives(
    data: LoopPeriodogram, spectrum: SpectrumModel
) -> tuple[float, FloatArray, FloatArray]:
    """Return L without the priors, its gradient (p,) and its information matrix (p, p)."""
    count, gain = data.count, spectrum.gain
    each, slopes, by_corner = densities(data, spectrum)
    model = each.sum(axis=0)
    ratio = data.power(gain) / model
    rows = [np.zeros_like(model), each[0] / model, by_corner * each[1] / model]
    for own, (by_frequency, by_damping) in zip(each[1:], slopes, strict=True):
        share = own / model
        rows += [by_frequency * share, by_damping * share, share]
    log_slopes = np.array(rows)
    weighted = log_slopes * count
    gradient = weighted @ (1 - ratio)
    information = weighted @ log_slopes.T
    # the gain changes the data, not the model
    cross, square = 2 * gain * data.crossed, 2 * gain**2 * data.corrected
    by_gain = (cross + square) / model
    gradient[GAIN] = np.sum(count * by_gain)
    information[GAIN] = information[:, GAIN] = -weighted @ by_gain
    information[GAIN, GAIN] = np.sum(count * (cross + 2 * square) / model)
    return float(np.sum(count * (np.log(model) + ratio))), gradient, information


def minimise(data: LoopPeriodogram, start: SpectrumModel, priors: Priors) -> FittedModel | None:
    """Minimise L by scoring in a trust region; None if L is not finite."""
    from scipy.optimize import minimize

    free, theta = priors.free, start.pack()
    centre, precision = priors.centre[free], 1 / priors.width[free] ** 2

    @lru_cache(maxsize=1)  # scipy asks for value, gradient and Hessian one after the other
    def evaluate(raw: bytes) -> tuple[float, FloatArray, FloatArray]:
        theta[free] = x = np.clip(np.frombuffer(raw), -_FARTHEST, _FARTHEST)
        value, gradient, information = derivatives(data, start.unpack(theta))
        away = x - centre
        return (
            value + 0.5 * float(np.sum(precision * away**2)),
            gradient[free] + precision * away,
            information[np.ix_(free, free)] + np.diag(precision),
        )

    found = minimize(  # type: ignore[call-overload]
        lambda x: evaluate(x.tobytes())[0],
        theta[free],
        jac=lambda x: evaluate(x.tobytes())[1],
        hess=lambda x: evaluate(x.tobytes())[2],
        method="trust-exact",
        options=_OPTIONS,
    )
    _, gradient, reduced = evaluate(found.x.tobytes())
    # what a Newton step would still gain
    left = 0.5 * float(gradient @ np.linalg.lstsq(reduced, gradient, rcond=None)[0])
    if not (np.isfinite(found.fun) and np.isfinite(left)):
        return None
    theta[free] = found.x
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
