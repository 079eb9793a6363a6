"""Physical parameters of a fitted model, with standard errors, and its nearest processes.

Lines that may be several, closer to each other than the record can separate.

The sum of two resonances within some half widths has nearly the spectrum of one, and the fit gives
one: at the mean of their frequencies, with the sum of their power. Its standard errors hold for
these. Here each line becomes two of like damping, and what that adds to the likelihood decides.
Below some separation it adds too little, and nobody can know.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lbt_synth.identification.fit import fitting
from lbt_synth.identification.fit.fitting import Search, close_line
from lbt_synth.identification.fit.identified_model import (
    IdentifiedAxis,
    IdentifiedLine,
    Kind,
)
from lbt_synth.identification.fit.periodogram import LoopPeriodogram, Whiteness
from lbt_synth.identification.fit.scoring import SEARCHED, Priors
from lbt_synth.identification.fit.spectrum_model import GAIN, SpectrumModel
from lbt_synth.identification.fit.whittle import (
    FittedModel,
    contrast,
    densities,
    density,
    derivatives,
    invert_information,
    minimise,
)
from lbt_synth.models import ARModel
from lbt_synth.models.resonance_spectrum import PARAMETERS, WIDE_DAMPING, coefficients
from lbt_synth.validation import FloatArray, frozen_copy

UNRESOLVED = 0.01  # half width times duration: narrower than that, a line looks like a sinusoid
_LEAST_NOISE = 0.01  # of the innovations: a filter for less trusts every measurement
_LEAST_PART = 1e-3  # of the noise: a part of the turbulence with less is none
_LAGS = 100
_LOWEST = 3  # bins in which the ends of the taper show
_DRIFTS_HZ = (0.3, 1.0, 3.0, 10.0)  # where a resonance in the place of a drift may lie
_DRIFT_DAMPING = 0.8
_LIKELY = 5.5  # log-likelihood that a split rarely adds to a single line
_WEAK = 40.0  # the same of a line in the skirts of another whose errors are too small
_SHARES = (0.5, 0.8, 0.2)  # of the power in the lower line, where a fit begins
_APART = 1.4  # half widths between the lines there
_NARROWER = -0.25  # of the logarithm of the damping
_LIKE = 0.5  # width of the prior around that
_REACH = 20.0  # half widths around a line that are fitted


def standard_errors(spectrum: SpectrumModel, covariance: FloatArray) -> SpectrumModel:
    """Return the standard error of each parameter of a model."""
    return spectrum.unpack(np.sqrt(np.maximum(np.diag(covariance), 0)))


def gain_covariance(
    search: Search, model: FittedModel, errors: Sequence[tuple[Sequence[int], float]]
) -> FloatArray:
    """Return the covariance of a fit whose gains have errors, and all that these move, (p, p).

    The errors are relative ones, each common to the gains of some axes.
    """
    rows = derivatives(search.merge(model.spectra), model.spectra)[2]
    gains = np.array(model.spectra.starts[:-1]) + GAIN
    information = model.information.copy()
    information[gains] = information[:, gains] = 0  # as if it were fitted at these gains
    held = invert_information(information)
    out = held
    for axes, error in errors:
        places = gains[list(axes)]
        moves = -held @ np.sum(rows[places], axis=0)
        moves[places] = 1
        out = out + error**2 * np.outer(moves, moves)
    return out


def hold_gain(search: Search, model: FittedModel, error: float) -> FittedModel:
    """Return a model of one axis with a relative error of its gain, and all that this moves."""
    covariance = gain_covariance(search, model, [([0], error)])
    return replace(model, information=invert_information(covariance))


def _colour_error(search: Search, spectrum: SpectrumModel) -> float:
    """Return the standard error that the colour of white noise would have if it were fitted."""
    information = derivatives(search.merge(spectrum), spectrum)[2]
    priors = search.priors(replace(spectrum, colour=1.0))
    fixed = np.setdiff1d(np.arange(priors.width.size), priors.free)
    information[fixed] = information[:, fixed] = 0
    information[priors.free, priors.free] += 1 / priors.width[priors.free] ** 2
    return standard_errors(spectrum, invert_information(information)).colour


def describe_axis(
    search: Search,
    model: FittedModel,
    gain_error: float | None,
    note: str,
    *,
    colour_error: float = 0.0,
    shared: Collection[int] = (),
) -> IdentifiedAxis:
    """Return a fitted model in the units of the phase.

    ``gain_error`` is the standard error of the logarithm of the gain, None where it is unknown;
    ``colour_error`` by how much the noise's correlation differs in models that are as likely. The
    components that are ``shared`` with another axis, by their places, keep their parameters.
    """
    data, spectrum, gain = search.data, model.spectrum, model.spectrum.gain
    rate = data.frame_rate_hz
    near = nearest_processes(search, model, shared)
    covariance = near.covariance
    errors = standard_errors(near.spectrum, covariance)
    slow = spectrum if spectrum.rolling == "turbulence" else near.spectrum
    each, _, _ = densities(data, near.spectrum)
    fitted = each.sum(axis=0) if near is model else density(data, spectrum)
    first, *lines = [
        _describe_line(search, near, i, errors, covariance, each)
        for i in range(len(spectrum.components))
    ]
    if slow is spectrum:  # its own parameters, not those of the nearest process
        first = _describe_line(search, model, 0, errors, covariance, each)
    background = fitted.copy()
    for line, own in zip(lines, each[2:], strict=True):
        if line.kind == "line":
            background -= own
    process = _turbulence_process(near.spectrum, rate)
    innovation = float(np.exp(0.5 * np.mean(np.log(fitted * rate / 2))))
    noise = max(float(np.exp(spectrum.log_noise / 2)), _LEAST_NOISE * innovation)
    correlation = float(np.tanh(spectrum.colour))
    # a drift that a fit has emptied keeps its place, as nothing else lets several parts roll off
    parts = [p for p in lines if p.kind != "turbulence" or p.rms_nm > _LEAST_PART * noise]
    return IdentifiedAxis(
        turbulence=process,
        turbulence_fit=_describe_turbulence(first, slow, errors, process),
        parts=tuple(sorted(parts, key=lambda part: part.frequency_hz)),
        noise_nm=noise,
        noise_error_nm=min(noise * errors.log_noise / 2, innovation),
        noise_correlation=correlation,
        noise_correlation_error=max(
            colour_error,
            (1 - correlation**2)
            * (errors.colour if spectrum.colour else _colour_error(search, spectrum)),
        ),
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
    search: Search,
    model: FittedModel,
    i: int,
    errors: SpectrumModel,
    covariance: FloatArray,
    each: FloatArray,
) -> IdentifiedLine:
    """Return the resonance of component i, given the density of ``each`` part (1 + parts, f)."""
    data, spectrum = search.data, model.spectrum
    line, error = spectrum.components[i], errors.components[i]
    frequency = line.frequency / data.angle_s
    damping = line.damping_ratio
    damping_error = damping * line.damping_slope * error.damping
    finest = 0.0 if data.duration_s is None else UNRESOLVED / data.duration_s / frequency
    resolved = damping >= finest
    if not resolved:
        damping = damping_error = finest
    rms = float(np.exp(line.log_power / 2 - spectrum.log_gain))
    by_gain = spectrum.unpack(covariance[GAIN])  # covariances with the gain
    variance = by_gain.log_gain - by_gain.components[i].log_power + error.log_power**2 / 4
    own = float(np.interp(frequency, data.frequency_hz, each[1 + i]))
    rest = float(np.interp(frequency, data.frequency_hz, each.sum(axis=0))) - own
    narrow = damping < WIDE_DAMPING and own > rest
    slow = line.kind == "slow" or frequency < search.lowest_line_hz
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
        prominence=own / rest if rest > 0 else float("inf"),
        evidence=model.evidence[i],
        announced=line.announced is not None,
    )


def _turbulence_process(spectrum: SpectrumModel, rate: float) -> ARModel:
    """Return the turbulence as a process of the phase."""
    slow = spectrum.components[0]
    a1, a2, drive = coefficients(slow.frequency, slow.damping_ratio)
    polynomial = np.array([1.0, -a1, -a2])
    size = np.exp(slow.log_power / 2 - spectrum.log_gain) * np.sqrt(drive)
    if spectrum.rolls_off:
        pole = np.exp(-np.exp(spectrum.log_corner))
        polynomial = np.convolve(polynomial, [1.0, -pole])
        size *= 1 - pole
    return ARModel(coefficients=-polynomial[1:], driving_rms_nm=float(size), frame_rate_hz=rate)


def _describe_turbulence(
    line: IdentifiedLine, spectrum: SpectrumModel, errors: SpectrumModel, process: ARModel
) -> IdentifiedLine:
    """Return the first component as turbulence, with the rms of its process, and its corner."""
    corner = float(np.exp(spectrum.log_corner)) * process.frame_rate_hz / (2 * np.pi)
    return replace(
        line,
        kind="turbulence",
        rms_nm=process.rms_nm,
        rms_error_nm=process.rms_nm * line.rms_error_nm / line.rms_nm,
        corner_hz=corner if spectrum.rolls_off else None,
        corner_error_hz=corner * errors.log_corner if spectrum.rolls_off else None,
    )


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
    correlation, p_value = np.zeros(0), float("nan")
    if ratio.size > 0.95 * whole:  # up to the Nyquist frequency
        lags = min(_LAGS, ratio.size // 16)
        filled = np.zeros(size // 2 + 1)  # from 0 to the Nyquist frequency
        filled[1:-1] = ratio - np.mean(ratio[_LOWEST:])
        filled[: 1 + _LOWEST] = 0
        correlation = np.fft.irfft(filled, size)[1 : lags + 1] * size / (2 * np.sum(ratio))
        p_value = float(chdtrc(lags, 2 * effective * float(np.sum(correlation**2))))
    return Whiteness(
        deviation=deviation,
        p_value=float(kolmogorov(deviation * np.sqrt(effective))),
        autocorrelation=frozen_copy(correlation),
        correlation_p_value=p_value,
        frequency_hz=data.frequency_hz,
        cumulative=frozen_copy(cumulative),
        effective=effective,
    )


def nearest_processes(
    search: Search, model: FittedModel, shared: Collection[int] = ()
) -> FittedModel:
    """Return a fit whose turbulence has a finite order, the nearest by its likelihood.

    Turbulence has the third order. Of a drift and turbulence, one has the first place, and the
    other one is a resonance: the turbulence, without its roll-off, or the drift, which then falls
    as a resonance does, where that is clearly nearer. Lines stay as they are, and so do components
    that are ``shared`` with another axis, by their places.
    """
    whole = model.spectrum
    if not whole.rolls_off:
        return model
    places = [i for i, c in enumerate(whole.components) if c.kind != "line"]
    slow = whole.keep(lambda c: c.kind != "line")
    data = search.merge(slow)
    held = density(data, whole.alone(*(line for line in whole.lines if not line.is_narrow)))
    zero = np.zeros_like(held)
    fitted = replace(data, measured=density(data, slow) + held, crossed=zero, corrected=zero)
    nearest = partial(_fit_nearest, search, fitted, held)
    if slow.rolling == "turbulence":
        start = replace(slow, roll_off_order=1.0)
        found = nearest(start, [0])
        return _with_slow(model, start if found is None else found.spectrum)
    moving = [i for i, place in enumerate(places) if place not in shared]
    kept = nearest(slow.without_roll_off(), moving)
    turbulence = [i for i in moving if i > 0]
    best = None
    if turbulence:
        place = slow.strongest(turbulence)
        starts = [_exchange_drift(search, slow, place, hz) for hz in _DRIFTS_HZ]
        best = fitting.likeliest(search, [nearest(start, moving) for start in starts])
    if best is None or (kept is not None and kept.contrast < best.contrast + search.price):
        return _with_slow(model, slow.without_roll_off() if kept is None else kept.spectrum)
    return _with_slow(_exchange_errors(model, places[place]), best.spectrum)


def _with_slow(model: FittedModel, slow: SpectrumModel) -> FittedModel:
    """Return a fit with other components in the places of those that are no lines."""
    others, whole = iter(slow.components), model.spectrum.components
    components = tuple(c if c.kind == "line" else next(others) for c in whole)
    return model.with_spectrum(replace(slow, components=components))


def _exchange_drift(
    search: Search, slow: SpectrumModel, place: int, frequency_hz: float
) -> SpectrumModel:
    """Return a model with turbulence of finite order before a drift, which is a resonance."""
    drift = search.component("slow", frequency_hz, _DRIFT_DAMPING, 1.0)
    drift = replace(drift, log_power=slow.components[0].log_power)
    return replace(slow.promote(place, drift), roll_off_order=1.0)


def _exchange_errors(model: FittedModel, place: int) -> FittedModel:
    """Return a fit with the information on its first component and another one exchanged."""
    order = np.arange(len(model.information))
    blocks = order[-PARAMETERS * len(model.spectrum.components) :].reshape(-1, PARAMETERS)
    blocks[[0, place]] = blocks[[place, 0]]
    return replace(model, information=model.information[np.ix_(order, order)])


def _fit_nearest(
    search: Search,
    fitted: LoopPeriodogram,
    held: FloatArray,
    start: SpectrumModel,
    moving: Collection[int],
) -> FittedModel | None:
    """Fit the components in some places, and the roll-off, to a spectrum at its gain and noise."""
    priors = search.priors(start)
    moves = np.repeat([i in moving for i in range(len(start.components))], PARAMETERS)
    first = np.zeros(priors.width.size - moves.size, dtype=np.bool_)
    first[-1] = start.rolls_off
    width = np.where(np.append(first, moves), priors.width, 0)
    return minimise(fitted, start, replace(priors, width=width), held=held)


def describe_close_lines(axis: IdentifiedAxis, name: int) -> Iterator[str]:
    """Yield notes on lines that may be several, and on lines that are hardly separate."""
    search, model = Search(data=axis.data), axis.fitted_model
    spectrum = model.spectrum
    lines = [i for i, c in enumerate(spectrum.components) if c.is_narrow]
    for i in lines:
        place = (
            f"warning: the line of axis {name} at {search.place(spectrum.components[i])[0]:.4g} Hz"
        )
        if split_gain(search, spectrum, i, worth=_LIKELY) > _LIKELY:
            yield (
                f"{place} may be two, closer than the record separates: its errors hold for the "
                "mean of their frequencies and for their power together"
            )
        elif model.evidence[i] < _WEAK and close_line(search, spectrum, i) is not None:
            yield f"{place} lies in the skirts of another: the errors of both may be too small"


def split_gain(search: Search, spectrum: SpectrumModel, i: int, *, worth: float = 0.0) -> float:
    """Return what two lines of like damping in the place of line i add to the log-likelihood.

    Nothing beside zero frequency, where there is no place for two. Fits that will hardly add what
    is worth it are given up.
    """
    line = spectrum.components[i]
    centre, half = search.place(line)
    if centre < 2 * half:
        return 0.0
    data = search.merge(spectrum).window(centre - _REACH * half, centre + _REACH * half)
    single, rest = contrast(data, spectrum), density(data, spectrum.exchange(i))
    best = single
    for share in _SHARES:
        lower, upper = (
            line.shift(float(np.log1p(move * half / centre)), _NARROWER, float(np.log(power)))
            for move, power in ((-_APART * (1 - share), share), (_APART * share, 1 - share))
        )
        start = spectrum.alone(lower, replace(upper, announced=None))
        width = np.zeros(start.pack().size)
        width[-2 * PARAMETERS :] = 2 * (np.inf, _LIKE, np.inf)
        priors = Priors(centre=start.pack(), width=width)
        found = minimise(data, start, priors, held=rest, bound=best - worth, accuracy=SEARCHED)
        if found is not None:
            away = (found.spectrum.pack() - priors.centre)[[1 - 2 * PARAMETERS, 1 - PARAMETERS]]
            best = min(best, found.contrast + float(np.sum((away / _LIKE) ** 2)) / 2)
    return single - best
