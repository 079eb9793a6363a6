"""Physical parameters of a fitted model, with standard errors, and tests of its innovations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbt_synth.identification.fit.fitting import Search
from lbt_synth.identification.fit.identified_model import (
    IdentifiedAxis,
    IdentifiedLine,
    Kind,
    Whiteness,
)
from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.identification.fit.spectrum_model import BACKGROUND, CORNER, GAIN, SpectrumModel
from lbt_synth.identification.fit.whittle import (
    DIFFERENCE,
    FittedModel,
    density,
    derivatives,
    invert_information,
    minimise,
    part_density,
)
from lbt_synth.models import ARModel
from lbt_synth.models.resonance_spectrum import WIDE_DAMPING, coefficients
from lbt_synth.validation import FloatArray, frozen_copy

UNRESOLVED = 0.01  # half width times duration: narrower than that, a line looks like a sinusoid
_LEAST_NOISE = 0.01  # of the innovations: a filter for less trusts every measurement
_LEAST_PART = 1e-3  # of the noise: a component with less has no power
_FASTEST = 8.0  # nepers per frame: a pole that decays faster is gone after a frame
_LAGS = 100
_LOWEST = 3  # bins in which the ends of the taper show


def standard_errors(spectrum: SpectrumModel, covariance: FloatArray) -> SpectrumModel:
    """Return the standard error of each parameter of a model."""
    return spectrum.unpack(np.sqrt(np.maximum(np.diag(covariance), 0)))


def gain_covariance(
    search: Search, model: FittedModel, errors: Sequence[tuple[Sequence[int], float]]
) -> FloatArray:
    """Return the covariance of a fit whose gains have errors, and all that these move, (p, p).

    The errors are relative ones, each common to the gains of some axes.
    """
    data, theta = search.merge(model.spectrum), model.spectrum.pack()
    gains = BACKGROUND * np.arange(len(model.spectrum.axes)) + GAIN
    information = model.information.copy()
    information[gains] = information[:, gains] = 0  # as if it were fitted at these gains
    held = covariance = invert_information(information)
    gradient = derivatives(data, model.spectrum)[1]
    for axes, error in errors:
        step = np.zeros_like(theta)
        step[gains[list(axes)]] = DIFFERENCE
        moved = derivatives(data, model.spectrum.unpack(theta + step))[1]
        moves = (step - held @ (moved - gradient)) / DIFFERENCE
        covariance = covariance + error**2 * np.outer(moves, moves)
    return covariance


def hold_gain(search: Search, model: FittedModel, error: float) -> FittedModel:
    """Return a model of one axis with a relative error of its gain, and all that this moves."""
    covariance = gain_covariance(search, model, [([0], error)])
    return replace(model, information=invert_information(covariance))


def describe_axis(
    search: Search,
    model: FittedModel,
    gain_error: float | None,
    note: str,
    *,
    colour_error: float = 0.0,
    directions: Sequence[tuple[tuple[float, float], float | None]] = (),
) -> IdentifiedAxis:
    """Return a fitted model in the units of the phase.

    ``gain_error`` is the standard error of the logarithm of the gain, None where it is given;
    ``colour_error`` by how much the noise's correlation differs in models that are as likely;
    ``directions`` those of the last components, which another axis has, too, and their errors.
    """
    data, spectrum = search.data, model.spectrum
    background, rate = spectrum.background, data.frame_rate_hz
    gain, covariance = background.gain, model.covariance
    errors = standard_errors(spectrum, covariance)
    densities = np.array([part_density(data, spectrum, i) for i in range(len(spectrum.components))])
    fitted = density(data, spectrum)
    first, *resonances = [
        _describe_line(search, model, i, errors, covariance, densities[i], fitted)
        for i in range(len(spectrum.components))
    ]
    own = len(resonances) - len(directions)
    for i, (direction, error) in enumerate(directions, start=own):
        resonances[i] = replace(resonances[i], direction=direction, direction_error_deg=error)
    smooth = fitted.copy()
    for resonance, line in zip(resonances, densities[1:], strict=True):
        if resonance.kind == "line":
            smooth -= line
    innovation = float(np.exp(0.5 * np.mean(np.log(fitted * rate / 2))))
    noise = max(float(np.exp(background.log_noise / 2)), _LEAST_NOISE * innovation)
    correlation = float(np.tanh(background.colour))
    parts = [resonance for resonance in resonances if resonance.rms_nm * gain > _LEAST_PART * noise]
    corner = float(np.exp(background.log_corner)) / data.angle_s
    corners = (
        (corner, corner * errors.background.log_corner) if background.rolls_off else (None,) * 2
    )
    turbulence = _turbulence_process(_nearest_process(search, spectrum), rate)
    slow = replace(
        first,
        kind="turbulence",
        rms_nm=turbulence.rms_nm,
        rms_error_nm=turbulence.rms_nm * first.rms_error_nm / first.rms_nm,
        corner_hz=corners[0],
        corner_error_hz=corners[1],
    )
    return IdentifiedAxis(
        turbulence=turbulence,
        turbulence_fit=slow,
        parts=tuple(sorted(parts, key=lambda part: part.frequency_hz)),
        noise_nm=noise,
        noise_error_nm=min(noise * errors.background.log_noise / 2, innovation),
        noise_correlation=correlation,
        noise_correlation_error=max(colour_error, (1 - correlation**2) * errors.background.colour),
        sensor_gain=gain,
        sensor_gain_error=None if gain_error is None else gain * gain_error,
        sensor_gain_note=note,
        whiteness=whiteness(data, data.power(gain), fitted),
        frequency_hz=data.frequency_hz,
        density_nm2_hz=frozen_copy(data.power(gain) / gain**2),
        fitted_nm2_hz=frozen_copy(fitted / gain**2),
        background_nm2_hz=frozen_copy(smooth / gain**2),
        frame_rate_hz=rate,
        resolution_hz=data.resolution_hz,
        fitted_model=model,
        data=data,
    )


def _describe_line(
    search: Search,
    model: FittedModel,
    i: int,
    errors: SpectrumModel,
    covariance: FloatArray,
    density: FloatArray,
    fitted: FloatArray,
) -> IdentifiedLine:
    """Return the resonance of component i, given its density and that of all, (f,) each."""
    data, spectrum = search.data, model.spectrum
    line, error = spectrum.components[i], errors.components[i]
    natural, damping = _without_fast_pole(line.frequency, line.damping_ratio)
    frequency = natural / data.angle_s
    damping_error = damping * line.damping_slope * error.damping
    finest = 0.0 if data.duration_s is None else UNRESOLVED / data.duration_s / frequency
    resolved = damping >= finest
    if not resolved:
        damping = damping_error = finest
    rms = float(np.exp(line.log_power / 2)) / spectrum.background.gain
    by_gain = spectrum.unpack(covariance[GAIN])  # covariances with the gain
    variance = by_gain.background.log_gain - by_gain.components[i].log_power
    variance += error.log_power**2 / 4
    height = float(np.interp(frequency, data.frequency_hz, density))
    rest = float(np.interp(frequency, data.frequency_hz, fitted - density))
    narrow = line.sections == 1 and damping < WIDE_DAMPING and height > rest
    slow = line.kind != "line" or frequency < search.lowest_line_hz
    kind: Kind = "turbulence" if slow else "line" if narrow else "broad"
    return IdentifiedLine(
        kind=kind,
        frequency_hz=frequency,
        frequency_error_hz=frequency * error.log_frequency,
        damping=damping,
        damping_error=damping_error,
        resolved=resolved,
        rms_nm=rms,
        rms_error_nm=rms * float(np.sqrt(max(variance, 0.0))),
        prominence=height / rest if rest > 0 else float("inf"),
        evidence=model.evidence[i],
        announced=line.announced is not None,
        sections=line.sections,
    )


def _without_fast_pole(frequency: float, damping: float) -> tuple[float, float]:
    """Return frequency and damping ratio with the faster of two real poles where it still shows.

    The frequency is an angle per frame. Nearly the same spectrum, but no coefficient of 1e-100.
    """
    if damping <= 1:
        return frequency, damping
    root = float(np.sqrt(damping**2 - 1))
    slow, fast = frequency / (damping + root), min(frequency * (damping + root), _FASTEST)
    natural = float(np.sqrt(slow * fast))
    return natural, (slow + fast) / (2 * natural)


def _nearest_process(search: Search, spectrum: SpectrumModel) -> SpectrumModel:
    """Return the turbulence as a process of the third order, the nearest by its likelihood.

    The noise, the wide resonances and the gain stay; narrow lines do not matter.
    """
    if not spectrum.background.rolls_off:
        return spectrum
    alone = replace(spectrum, components=spectrum.components[:1])
    data = search.merge(alone)
    wide = (c for c in spectrum.components[1:] if not c.is_narrow)
    held = density(data, spectrum.alone(*wide))
    seen, zero = density(data, alone) + held, np.zeros_like(held)
    fitted = replace(data, measured=seen, crossed=zero, corrected=zero)
    priors = search.priors(alone)
    width = priors.width.copy()
    width[:CORNER] = 0.0  # only the turbulence and its corner move
    start = replace(alone, roll_off_order=1.0)
    nearest = minimise(fitted, start, replace(priors, width=width), held=held)
    return start if nearest is None else nearest.spectrum


def _turbulence_process(spectrum: SpectrumModel, rate: float) -> ARModel:
    """Return the turbulence as a process of the phase, of order 2, or 3 with a roll-off."""
    slow, background = spectrum.components[0], spectrum.background
    a1, a2, drive = coefficients(*_without_fast_pole(slow.frequency, slow.damping_ratio))
    polynomial = np.array([1.0, -a1, -a2])
    size = np.exp(slow.log_power / 2) / background.gain * np.sqrt(drive)
    if background.rolls_off:
        pole = np.exp(-np.exp(background.log_corner))
        polynomial = np.convolve(polynomial, [1.0, -pole])
        size *= 1 - pole
    return ARModel(coefficients=-polynomial[1:], driving_rms_nm=float(size), frame_rate_hz=rate)


def whiteness(data: LoopPeriodogram, power: FloatArray, model: FloatArray) -> Whiteness:
    """Test whether power and model (f,) differ as white innovations do."""
    from scipy.special import chdtrc, kolmogorov

    ratio = power / model
    effective = float(np.sum(data.count))
    cumulative = np.cumsum(ratio) / np.sum(ratio)
    deviation = float(np.max(np.abs(cumulative - np.arange(1, ratio.size + 1) / ratio.size)))
    # a periodogram of n frames has n / 2 values; bins count as they are independent
    size = 2 * (ratio.size + 1)
    whole = data.frequency_hz.size / data.frequency_hz[-1] * data.frame_rate_hz / 2
    p_value = float("nan")
    if ratio.size > 0.95 * whole:  # up to the Nyquist frequency
        lags = min(_LAGS, ratio.size // 16)
        filled = np.zeros(size // 2 + 1)  # from 0 to the Nyquist frequency
        filled[1:-1] = ratio - np.mean(ratio[_LOWEST:])
        filled[: 1 + _LOWEST] = 0
        correlation = np.fft.irfft(filled, size)[1 : lags + 1] * size / (2 * np.sum(ratio))
        p_value = float(chdtrc(lags, 2 * effective * float(np.sum(correlation**2))))
    return Whiteness(
        cumulative=frozen_copy(cumulative),
        deviation=deviation,
        effective=effective,
        p_value=float(kolmogorov(deviation * np.sqrt(effective))),
        correlation_p_value=p_value,
    )
