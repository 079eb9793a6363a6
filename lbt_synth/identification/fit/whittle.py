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
from typing import Any

import numpy as np

from lbt_synth.errors import NumericalError
from lbt_synth.identification.fit.periodogram import LoopPeriodogram, half_angle_square
from lbt_synth.identification.fit.taper import FAR, WIDE, log_smearing
from lbt_synth.models.resonance_spectrum import PARAMETERS, log_density, log_roll_off
from lbt_synth.validation import BoolArray, FloatArray

GAIN, NOISE, CORNER, _FIRST = 0, 1, 2, 3  # places in the vector of parameters
FREQUENCY, DAMPING, VARIANCE = 0, 1, 2  # places among the parameters of a component
_LEAST = 0.05  # damping ratio of turbulence; narrower components are lines
_JUST_ABOVE = 1e-3
_DIFFERENCE = 1e-4  # of a logarithm
_FARTHEST = 60.0  # of a logarithm: exp stays finite


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Priors:
    """Normal priors on the logarithms of the parameters; an infinite width is none."""

    centre: FloatArray  # (p,): means
    width: FloatArray  # (p,): standard deviations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minimum:
    """A minimum of the likelihood."""

    # (p,): logarithms of sensor gain, noise variance, corner of the first component's roll-off, and
    # (frequency, damping, variance) of each component; frequencies as angles per frame. The damping
    # of the first, the turbulence, is above 0.05: its parameter is ``log(zeta - 0.05)``; that of
    # all others is below 1: ``log(zeta / (1 - zeta))``.
    parameters: FloatArray
    contrast: float  # L without the priors
    information: FloatArray  # (p, p): second derivatives of L, expected ones for the model


def component_slice(i: int) -> slice:
    """Return where the frequency, damping and variance of a component stand."""
    return slice(_FIRST + PARAMETERS * i, _FIRST + PARAMETERS * (i + 1))


def component(values: FloatArray, i: int) -> FloatArray:
    """Return a view of what belongs to a component, of parameters or rows by parameter."""
    return values[component_slice(i)]


def damping_ratio(parameter: float, *, first: bool) -> float:
    """Return the damping ratio of a component from its parameter."""
    return float(_LEAST + np.exp(parameter)) if first else float(1 / (1 + np.exp(-parameter)))


def damping_slope(ratio: float, *, first: bool) -> float:
    """Return the derivative of the logarithm of a damping ratio by its parameter."""
    return 1 - _LEAST / ratio if first else 1 - ratio


def damping_parameter(ratio: float, *, first: bool) -> float:
    """Return the parameter of a damping ratio."""
    if first:
        return float(np.log(max(ratio - _LEAST, _JUST_ABOVE)))
    return float(np.log(ratio / (1 - ratio)))


class Likelihood:
    """Value, gradient and information of L for one periodogram."""

    def __init__(self, data: LoopPeriodogram) -> None:
        self.data = data
        self._s = half_angle_square(data.frequency_hz, data.frame_rate_hz)
        self._white = 2 / data.frame_rate_hz

    def parts(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the densities of noise and components, (1 + c, f), with log derivatives.

        The derivatives by frequency and damping are (c, 2, f), those of the first component by
        its corner (f,).
        """
        count = (theta.size - _FIRST) // PARAMETERS
        density = np.empty((1 + count, self._s.size))
        slopes = np.empty((count, 2, self._s.size))
        fall, by_corner = log_roll_off(float(np.exp(theta[CORNER])), self._s)
        density[0] = self._white * np.exp(theta[NOISE])
        for i in range(count):
            f, damping, variance = component(theta, i)
            ratio = damping_ratio(damping, first=i == 0)
            value, slopes[i, 0], slopes[i, 1] = log_density(np.exp(f), ratio, self._s)
            if i == 0:
                value = value + fall
            else:
                self._smear(float(np.exp(f)), ratio, value, slopes[i])
            slopes[i, 1] *= damping_slope(ratio, first=i == 0)
            np.exp(value + (variance + np.log(self._white)), out=density[1 + i])
        return density, slopes, by_corner

    def _smear(self, frequency: float, ratio: float, value: FloatArray, slopes: FloatArray) -> None:
        """Let the taper smear a narrow line, in place; ``slopes`` are by log f and log damping."""
        data = self.data
        if data.duration_s is None:
            return
        centre = frequency * data.frame_rate_hz / (2 * np.pi)
        half_width = ratio * centre * data.duration_s
        if half_width > WIDE:
            return
        reach = FAR / data.duration_s
        start, stop = np.searchsorted(data.frequency_hz, [centre - reach, centre + reach])
        distance = (data.frequency_hz[start:stop] - centre) * data.duration_s
        more, by_width, by_distance = log_smearing(half_width, distance)
        value[start:stop] += more
        slopes[0, start:stop] += by_width - by_distance * centre * data.duration_s
        slopes[1, start:stop] += by_width

    def model(self, theta: FloatArray) -> FloatArray:
        """Return the density of the whole spectrum, (f,)."""
        return np.asarray(self.parts(theta)[0].sum(axis=0))

    def contrast(self, theta: FloatArray) -> float:
        """Return L without the priors."""
        model = self.model(theta)
        power = self.data.power(float(np.exp(theta[GAIN])))
        return float(np.sum(self.data.count * (np.log(model) + power / model)))

    def derivatives(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return L without the priors, its gradient and its information matrix."""
        data, count = self.data, self.data.count
        gain = float(np.exp(theta[GAIN]))
        density, slopes, by_corner = self.parts(theta)
        model = density.sum(axis=0)
        power = data.power(gain)
        ratio = power / model
        log_slopes = np.empty((theta.size, model.size))
        log_slopes[GAIN] = 0
        log_slopes[NOISE] = density[0] / model
        log_slopes[CORNER] = by_corner * density[1] / model
        for i in range(len(slopes)):
            share = density[1 + i] / model
            rows = component(log_slopes, i)
            np.multiply(slopes[i], share, out=rows[:VARIANCE])
            rows[VARIANCE] = share
        weighted = log_slopes * count
        gradient = weighted @ (1 - ratio)
        information = weighted @ log_slopes.T
        # the gain moves the data, not the model
        cross, square = 2 * gain * data.crossed, 2 * gain**2 * data.corrected
        by_gain = (cross + square) / model
        gradient[GAIN] = np.sum(count * by_gain)
        information[GAIN] = information[:, GAIN] = -weighted @ by_gain
        information[GAIN, GAIN] = np.sum(count * (cross + 2 * square) / model)
        value = float(np.sum(count * (np.log(model) + ratio)))
        return value, gradient, information


def minimise(
    likelihood: Likelihood, start: FloatArray, priors: Priors, *, free: BoolArray, steps: int = 40
) -> Minimum:
    """Minimise L from a start (p,) over the free parameters, by scoring in a trust region."""
    from scipy.optimize import minimize

    moves = np.flatnonzero(np.asarray(free))
    precision = 1 / np.asarray(priors.width) ** 2
    theta = start.copy()
    seen: dict[bytes, tuple[float, FloatArray, FloatArray]] = {}

    def at(x: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        key = x.tobytes()
        if key not in seen:
            full = theta.copy()
            full[moves] = np.clip(x, -_FARTHEST, _FARTHEST)
            value, gradient, information = likelihood.derivatives(full)
            away = full - priors.centre
            value += 0.5 * float(np.sum(precision * away**2))
            gradient = gradient + precision * away
            information = information + np.diag(precision)
            seen.clear()
            seen[key] = value, gradient[moves], information[np.ix_(moves, moves)]
        return seen[key]

    options: dict[str, Any] = {
        "maxiter": steps,
        "gtol": 1e-3,
        "initial_trust_radius": 1.0,
        "max_trust_radius": 8.0,
    }
    found = minimize(  # type: ignore[call-overload]
        lambda x: at(x)[0],
        start[moves],
        jac=lambda x: at(x)[1],
        hess=lambda x: at(x)[2],
        method="trust-exact",
        options=options,
    )
    theta[moves] = found.x
    _, gradient, reduced = at(found.x)
    # what a Newton step would still gain
    left = 0.5 * float(gradient @ np.linalg.lstsq(reduced, gradient, rcond=None)[0])
    if not (np.isfinite(found.fun) and np.isfinite(left)):
        raise NumericalError(
            "the likelihood of the spectrum is not finite. Check the units of the series.",
            status=str(found.message),
        )
    information = np.zeros((start.size, start.size))
    information[np.ix_(moves, moves)] = reduced
    return Minimum(parameters=theta, contrast=likelihood.contrast(theta), information=information)


def add_observed_information(
    likelihood: Likelihood, minimum: Minimum, priors: Priors, *, free: BoolArray
) -> Minimum:
    """Return a minimum with the exact second derivatives of L, by differences of its gradient.

    Where they are not positive definite, the expected ones stay.
    """
    moves = np.flatnonzero(np.asarray(free))
    theta = minimum.parameters
    exact = np.zeros((theta.size, theta.size))
    for i in moves:
        step = np.zeros(theta.size)
        step[i] = _DIFFERENCE
        up, down = (likelihood.derivatives(theta + sign * step)[1] for sign in (1, -1))
        exact[i] = (up - down) / (2 * _DIFFERENCE)
    exact = (exact + exact.T) / 2 + np.diag(1 / np.asarray(priors.width) ** 2)
    block = exact[np.ix_(moves, moves)]
    if np.any(np.diag(block) <= 0) or np.min(np.linalg.eigvalsh(block)) <= 0:
        return minimum
    exact = np.zeros_like(exact)
    exact[np.ix_(moves, moves)] = block
    return replace(minimum, information=exact)
