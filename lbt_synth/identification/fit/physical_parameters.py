"""A fit in the units of the phase, with standard errors."""

from __future__ import annotations

import numpy as np

from lbt_synth.identification.fit.identified_model import (
    IdentifiedAxis,
    IdentifiedLine,
    IdentifiedTurbulence,
    Kind,
)
from lbt_synth.identification.fit.order_search import Rules
from lbt_synth.identification.fit.parameters import FittedModel, has_corner
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.whiteness import whiteness
from lbt_synth.identification.fit.whittle import (
    CORNER,
    FIRST,
    GAIN,
    NOISE,
    Likelihood,
    damping_ratio,
    damping_slope,
)
from lbt_synth.models import ARModel
from lbt_synth.models.resonance_spectrum import PARAMETERS, coefficients
from lbt_synth.validation import FloatArray, frozen

UNRESOLVED = 0.01  # half width times duration: narrower than that, a line looks like a sinusoid
WIDE_DAMPING = 0.1
_LEAST_NOISE = 0.01  # of the innovations: a filter for less trusts every measurement


def parameter_covariance(grown: FittedModel, known: float | None = None) -> FloatArray:
    """Inverse of the information over the parameters that moved.

    With a gain that is known with a standard error of its logarithm, what that moves is added to
    the covariance at that gain.
    """
    information = grown.fitted.information
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
    w, damping = float(np.exp(theta[FIRST])), damping_ratio(theta[FIRST + 1], first=True)
    a1, a2, drive = coefficients(w, damping)
    polynomial = np.array([1.0, -a1, -a2])
    size = np.exp(theta[FIRST + 2] / 2 - theta[GAIN]) * np.sqrt(drive)
    if has_corner(theta):
        pole = np.exp(-np.exp(theta[CORNER]))
        polynomial = np.convolve(polynomial, [1.0, -pole])
        size *= 1 - pole
    return ARModel(coefficients=-polynomial[1:], driving_rms_nm=float(size), frame_rate_hz=rate)


def describe_axis(
    data: LoopPeriodogram,
    rules: Rules,
    grown: FittedModel,
    gain_error: float | None,
    note: str,
    *,
    known: float | None = None,
) -> IdentifiedAxis:
    """Return the fit in the units of the phase, with standard errors."""
    theta, rate = grown.theta, data.frame_rate_hz
    covariance = parameter_covariance(grown, known)
    error = np.sqrt(np.maximum(np.diag(covariance), 0))
    gain = float(np.exp(theta[GAIN]))
    to_hz = rate / (2 * np.pi)
    density, _, _ = Likelihood(data).parts(theta)
    fitted = density.sum(axis=0)
    lines: list[IdentifiedLine] = []
    background = fitted.copy()
    for i, part in enumerate(grown.parts):
        if i == 0:
            continue
        at = FIRST + PARAMETERS * i
        frequency = float(np.exp(theta[at])) * to_hz
        damping = damping_ratio(theta[at + 1], first=False)
        damping_error = damping * damping_slope(damping, first=False) * float(error[at + 1])
        finest = 0.0 if data.duration_s is None else UNRESOLVED / data.duration_s / frequency
        resolved = damping >= finest
        if not resolved:
            damping = damping_error = finest
        rms = float(np.exp(theta[at + 2] / 2 - theta[GAIN]))
        along = np.zeros(theta.size)
        along[at + 2], along[GAIN] = 0.5, -1.0
        own = float(np.interp(frequency, data.frequency_hz, density[1 + i]))
        rest = float(np.interp(frequency, data.frequency_hz, fitted)) - own
        narrow = damping < WIDE_DAMPING and own > rest
        kind: Kind = "line" if narrow else "broad"
        if frequency < rules.lowest_line_hz:
            kind = "turbulence"
        if kind == "line":
            background -= density[1 + i]
        lines.append(
            IdentifiedLine(
                kind=kind,
                frequency_hz=frequency,
                frequency_error_hz=frequency * float(error[at]),
                damping=damping,
                damping_error=damping_error,
                resolved=resolved,
                rms_nm=rms,
                rms_error_nm=rms * float(np.sqrt(along @ covariance @ along)),
                prominence=own / rest if rest > 0 else float("inf"),
                evidence=grown.evidence[i],
                announced=part.frequency is not None,
            )
        )
    innovation = float(np.exp(0.5 * np.mean(np.log(fitted * rate / 2))))
    noise = max(float(np.exp(theta[NOISE] / 2)), _LEAST_NOISE * innovation)
    return IdentifiedAxis(
        turbulence=_turbulence(theta, rate),
        turbulence_fit=_turbulence_fit(theta, covariance, rate),
        parts=tuple(sorted(lines, key=lambda line: line.frequency_hz)),
        noise_nm=noise,
        noise_error_nm=min(noise * float(error[NOISE]) / 2, innovation),
        sensor_gain=gain,
        sensor_gain_error=None if gain_error is None else gain * gain_error,
        sensor_gain_note=note,
        whiteness=whiteness(data, data.power(gain), fitted),
        frequency_hz=data.frequency_hz,
        density_nm2_hz=frozen(data.power(gain) / gain**2),
        fitted_nm2_hz=frozen(fitted / gain**2),
        background_nm2_hz=frozen(background / gain**2),
        frame_rate_hz=rate,
        resolution_hz=data.resolution_hz,
        fitted_model=grown,
        data=data,
    )


def _turbulence_fit(theta: FloatArray, covariance: FloatArray, rate: float) -> IdentifiedTurbulence:
    """Parameters of the turbulence; the error of its rms by differences."""
    error = np.sqrt(np.maximum(np.diag(covariance), 0))
    slope = np.zeros(theta.size)
    for i in (GAIN, CORNER, FIRST, FIRST + 1, FIRST + 2):
        step = np.zeros(theta.size)
        step[i] = 1e-4
        up, down = (np.log(_turbulence(theta + s * step, rate).rms_nm) for s in (1, -1))
        slope[i] = (up - down) / 2e-4
    rms = _turbulence(theta, rate).rms_nm
    to_hz = rate / (2 * np.pi)
    frequency = float(np.exp(theta[FIRST])) * to_hz
    damping = damping_ratio(theta[FIRST + 1], first=True)
    corner = float(np.exp(theta[CORNER])) * to_hz if has_corner(theta) else None
    return IdentifiedTurbulence(
        frequency_hz=frequency,
        frequency_error_hz=frequency * float(error[FIRST]),
        damping=damping,
        damping_error=damping * damping_slope(damping, first=True) * float(error[FIRST + 1]),
        corner_hz=corner,
        corner_error_hz=None if corner is None else corner * float(error[CORNER]),
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(slope @ covariance @ slope)),
    )
