"""Physical parameters of a fitted model, with standard errors."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.fit.identified_model import (
    IdentifiedAxis,
    IdentifiedLine,
    IdentifiedTurbulence,
    Kind,
)
from lbt_synth.identification.fit.model_fitter import Rules
from lbt_synth.identification.fit.parameters import FittedModel, has_corner
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.whiteness import whiteness
from lbt_synth.identification.fit.whittle import (
    CORNER,
    DAMPING,
    FREQUENCY,
    GAIN,
    NOISE,
    VARIANCE,
    Likelihood,
    component,
    component_slice,
    damping_ratio,
    damping_slope,
)
from lbt_synth.models import ARModel
from lbt_synth.models.resonance_spectrum import coefficients
from lbt_synth.validation import FloatArray, frozen_copy

UNRESOLVED = 0.01  # half width times duration: narrower than that, a line looks like a sinusoid
WIDE_DAMPING = 0.1
_LEAST_NOISE = 0.01  # of the innovations: a filter for less trusts every measurement


def parameter_covariance(model: FittedModel, known: float | None = None) -> FloatArray:
    """Return the inverse of the information over the parameters that moved.

    ``known`` is the standard error of the logarithm of a given gain: its effect is added to the
    covariance at that gain.
    """
    information = model.minimum.information
    moved = np.diag(information) > 0
    if known is not None:
        moved[GAIN] = False
    moves = np.flatnonzero(moved)
    block = information[np.ix_(moves, moves)]
    scale = 1 / np.sqrt(np.diag(block))
    both = np.outer(scale, scale)
    out = np.zeros_like(information)
    out[np.ix_(moves, moves)] = np.linalg.pinv(block * both, hermitian=True) * both
    if known is not None:
        slope = -out @ information[:, GAIN]
        slope[GAIN] = 1
        out += np.outer(slope, slope) * known**2
    return out


def _turbulence(theta: FloatArray, rate: float) -> ARModel:
    """Return the first component as a process of the phase."""
    frequency, damping, variance = component(theta, 0)
    a1, a2, drive = coefficients(float(np.exp(frequency)), damping_ratio(damping, first=True))
    polynomial = np.array([1.0, -a1, -a2])
    size = np.exp(variance / 2 - theta[GAIN]) * np.sqrt(drive)
    if has_corner(theta):
        pole = np.exp(-np.exp(theta[CORNER]))
        polynomial = np.convolve(polynomial, [1.0, -pole])
        size *= 1 - pole
    return ARModel(coefficients=-polynomial[1:], driving_rms_nm=float(size), frame_rate_hz=rate)


def describe_axis(
    data: LoopPeriodogram,
    rules: Rules,
    model: FittedModel,
    gain_error: float | None,
    note: str,
    *,
    known: float | None = None,
) -> IdentifiedAxis:
    """Return a fitted model in the units of the phase.

    ``gain_error`` is the standard error of the logarithm of the gain, None where the data do not
    tell it; ``known`` as for :func:`parameter_covariance`.
    """
    theta, rate = model.theta, data.frame_rate_hz
    covariance = parameter_covariance(model, known)
    gain = float(np.exp(theta[GAIN]))
    density, _, _ = Likelihood(data).parts(theta)
    fitted = density.sum(axis=0)
    lines = [
        _describe_line(data, rules, model, i, covariance, density)
        for i in range(1, len(model.parts))
    ]
    background = fitted.copy()
    for line, own in zip(lines, density[2:], strict=True):
        if line.kind == "line":
            background -= own
    innovation = float(np.exp(0.5 * np.mean(np.log(fitted * rate / 2))))
    noise = max(float(np.exp(theta[NOISE] / 2)), _LEAST_NOISE * innovation)
    return IdentifiedAxis(
        turbulence=_turbulence(theta, rate),
        turbulence_fit=_turbulence_fit(theta, covariance, rate),
        parts=tuple(sorted(lines, key=lambda line: line.frequency_hz)),
        noise_nm=noise,
        noise_error_nm=min(noise * float(_standard_errors(covariance)[NOISE]) / 2, innovation),
        sensor_gain=gain,
        sensor_gain_error=None if gain_error is None else gain * gain_error,
        sensor_gain_note=note,
        whiteness=whiteness(data, data.power(gain), fitted),
        frequency_hz=data.frequency_hz,
        density_nm2_hz=frozen_copy(data.power(gain) / gain**2),
        fitted_nm2_hz=frozen_copy(fitted / gain**2),
        background_nm2_hz=frozen_copy(background / gain**2),
        frame_rate_hz=rate,
        resolution_hz=data.resolution_hz,
        fitted_model=model,
        data=data,
    )


def _describe_line(
    data: LoopPeriodogram,
    rules: Rules,
    model: FittedModel,
    i: int,
    covariance: FloatArray,
    density: FloatArray,
) -> IdentifiedLine:
    """Return the resonance of component i, given the ``density`` (1 + parts, f) of each part."""
    theta = model.theta
    log_frequency, odds, log_variance = component(theta, i)
    log_error = component(_standard_errors(covariance), i)
    frequency = float(np.exp(log_frequency)) * (data.frame_rate_hz / (2 * np.pi))
    damping = damping_ratio(odds, first=False)
    damping_error = damping * damping_slope(damping, first=False) * float(log_error[DAMPING])
    finest = 0.0 if data.duration_s is None else UNRESOLVED / data.duration_s / frequency
    resolved = damping >= finest
    if not resolved:
        damping = damping_error = finest
    rms = float(np.exp(log_variance / 2 - theta[GAIN]))
    along = np.zeros(theta.size)
    component(along, i)[VARIANCE], along[GAIN] = 0.5, -1.0
    own = float(np.interp(frequency, data.frequency_hz, density[1 + i]))
    rest = float(np.interp(frequency, data.frequency_hz, density.sum(axis=0))) - own
    narrow = damping < WIDE_DAMPING and own > rest
    kind: Kind = "line" if narrow else "broad"
    if frequency < rules.lowest_line_hz:
        kind = "turbulence"
    return IdentifiedLine(
        kind=kind,
        frequency_hz=frequency,
        frequency_error_hz=frequency * float(log_error[FREQUENCY]),
        damping=damping,
        damping_error=damping_error,
        resolved=resolved,
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(along @ covariance @ along)),
        prominence=own / rest if rest > 0 else float("inf"),
        evidence=model.evidence[i],
        announced=model.parts[i].frequency is not None,
    )


def _standard_errors(covariance: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.diag(covariance), 0))


def _turbulence_fit(theta: FloatArray, covariance: FloatArray, rate: float) -> IdentifiedTurbulence:
    """Return the parameters of the turbulence; the error of its rms is by differences."""
    error = _standard_errors(covariance)
    slope = np.zeros(theta.size)
    for i in (GAIN, CORNER, *range(theta.size)[component_slice(0)]):
        step = np.zeros(theta.size)
        step[i] = 1e-4
        up, down = (np.log(_turbulence(theta + s * step, rate).rms_nm) for s in (1, -1))
        slope[i] = (up - down) / 2e-4
    rms = _turbulence(theta, rate).rms_nm
    to_hz = rate / (2 * np.pi)
    log_error = component(error, 0)
    frequency = float(np.exp(component(theta, 0)[FREQUENCY])) * to_hz
    damping = damping_ratio(component(theta, 0)[DAMPING], first=True)
    corner = float(np.exp(theta[CORNER])) * to_hz if has_corner(theta) else None
    return IdentifiedTurbulence(
        frequency_hz=frequency,
        frequency_error_hz=frequency * float(log_error[FREQUENCY]),
        damping=damping,
        damping_error=damping * damping_slope(damping, first=True) * float(log_error[DAMPING]),
        corner_hz=corner,
        corner_error_hz=None if corner is None else corner * float(error[CORNER]),
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(slope @ covariance @ slope)),
    )
