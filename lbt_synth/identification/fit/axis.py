"""The model of one axis: turbulence, lines, noise and sensor gain from series or spectra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.fit.fitting import (
    GAINS,
    LOWEST_LINE_HZ,
    MOST_LINES,
    PLAUSIBLE_GAINS,
    Search,
)
from lbt_synth.identification.fit.identified_model import IdentifiedAxis
from lbt_synth.identification.fit.order_search import (
    find_coloured_rival,
    search_model,
    search_models,
    try_other_gains,
)
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    LoopPeriodogram,
    loop_periodogram,
)
from lbt_synth.identification.fit.physical_parameters import (
    describe_axis,
    hold_gain,
    measure_separations,
    standard_errors,
)
from lbt_synth.identification.fit.whittle import FittedModel
from lbt_synth.identification.stretches import StretchesLike, checked_stretches
from lbt_synth.validation import FloatArray, number, real_array, require_instance

_GAIN_ERROR = 0.3  # relative; a gain with a larger error is not identifiable
_POOR_GAIN = 0.1  # relative error from which a note says so
_ROUGH_GAIN = 0.05  # relative error from which other gains are tried
_LEAST_AVERAGES, _MOST_AVERAGES = 0.25, 1000.0


def identify_axis(
    measurement: ArrayLike,
    correction: ArrayLike | None = None,
    *,
    frame_rate_hz: float,
    stretches: StretchesLike | None = None,
    sensor_gain: float | None = None,
    sensor_gain_error: float = 0.0,
    assumed_gain: float = 1.0,
    announced: Sequence[tuple[float, float]] = (),
    lowest_line_hz: float = LOWEST_LINE_HZ,
    most_lines: int = MOST_LINES,
    start: IdentifiedAxis | None = None,
) -> IdentifiedAxis:
    """Identify one axis of a loop.

    The pseudo-open-loop measurement ``y(k) + g c(k)``, with c(k) the correction that y(k)
    contains and g the sensor gain, is g times the phase plus the noise. Its spectrum is the sum
    of turbulence (a second-order process, with the roll-off of tilt if the data ask for it),
    resonances and noise: white, or a first-order process where the data ask for it. The Whittle
    likelihood chooses all parameters, the sensor gain among them, and a penalised criterion the
    number of resonances.

    Parameters
    ----------
    measurement : (frames,) array_like
        Measurement y(k) [nm].
    correction : (frames,) array_like, optional
        Correction c(k) contained in y(k) [nm]; none for an open loop.
    frame_rate_hz : float
        Frame rate [Hz].
    stretches : sequence of (start, stop), optional
        Frames to use; all by default.
    sensor_gain : float, optional
        Known sensor gain; by default it is found from the data of a closed loop.
    sensor_gain_error : float, optional
        Standard error of a given gain, part of the errors of all that depends on it.
    assumed_gain : float, optional
        Sensor gain to use if the data do not determine it.
    announced : sequence of (frequency, error), optional
        Known frequencies of lines, with their standard errors [Hz].
    lowest_line_hz : float, optional
        A resonance below is a part of the turbulence [Hz].
    most_lines : int, optional
        Most resonances above it.
    start : IdentifiedAxis, optional
        An earlier result to start from.

    Returns
    -------
    IdentifiedAxis
        Parameters with standard errors, tests and spectra.

    Raises
    ------
    ProblemError
        If a value is out of range or not finite, sizes clash, or no stretch has 512 frames.
    NumericalError
        If the fit fails.

    Notes
    -----
    Standard errors are those of the likelihood. They do not cover errors of the model itself.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.005, rms_nm=30, direction=(1.0,))
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    >>> loop = lbt.integrator(path, gain=0.4)
    >>> run = lbt.simulate(loop.controller, truth, hardware=path, frames=20_000)
    >>> y, u = run.measurements[0, :, 0], run.commands[0, :, 0]
    >>> found = lbt.identification.identify_axis(y[2:], u[:-2], frame_rate_hz=500)
    >>> [round(line.frequency_hz) for line in found.lines], round(found.noise_nm)
    ([40], 5)
    """
    search = Search(
        data=axis_periodogram(measurement, correction, frame_rate_hz, stretches),
        gain=sensor_gain,
        announced=announced,
        lowest_line_hz=lowest_line_hz,
        most_lines=most_lines,
    )
    found = find_axis(
        search, sensor_gain_error=sensor_gain_error, assumed_gain=assumed_gain, start=start
    )
    return measure_separations(found)


def find_axis(
    search: Search,
    *,
    sensor_gain_error: float = 0.0,
    assumed_gain: float,
    start: IdentifiedAxis | None,
) -> IdentifiedAxis:
    """Identify one axis from its periodogram, but for what its lines may hide."""
    data, sensor_gain = search.data, search.gain
    given_error = number(sensor_gain_error, "sensor_gain_error", at_least=0)
    assumed = number(assumed_gain, "assumed_gain", **GAINS)
    if start is not None:
        require_instance(start, IdentifiedAxis)
    model, *rivals = search_models(search, None if start is None else start.fitted_model.spectrum)
    if sensor_gain is not None:
        relative = given_error / sensor_gain
        if relative:
            model = hold_gain(search, model, relative)
        note = "given" if data.closed else "given: the series is divided by it"
        return describe_axis(search, model, relative or None, note)
    if not data.closed:
        return describe_axis(search, model, None, "1: of an open loop it has no meaning")
    model, near = _compare_gains(search, model, rivals)
    own = model.spectrum
    own_error = _gain_error(model)
    coloured = find_coloured_rival(search, model, own_error)
    near += [] if coloured is None else [coloured]
    away = max((abs(each.spectrum.log_gain - own.log_gain) for each in near), default=0.0)
    colours = np.tanh([own.colour, *(each.spectrum.colour for each in near)])
    unknown = float(np.ptp(colours))  # correlation of the noise
    error = max(own_error, away)
    if error <= _GAIN_ERROR:
        poor = f", to {100 * error:.0f} % only" if error > _POOR_GAIN else ""
        if error > own_error:  # what the gain moves is as ambiguous
            model = hold_gain(search, model, error)
        note = f"found in the closed loop's data{poor}"
        return describe_axis(search, model, error, note, colour_error=unknown)
    likely = _likely_gains([model, *near], own_error) if near else None
    search = replace(search, gain=assumed)
    by = f" by {100 * error:.0f} %" if error < 1 else ""
    note = (
        f"assumed to be {assumed:g}, not found: these data leave it open{by} (the loop "
        "hardly acts where the noise shows). Give it, or record with a higher loop gain"
    )
    model = search_model(search, model.spectrum)
    found = describe_axis(search, model, None, note, colour_error=unknown)
    return replace(found, likely_gains=likely)


def _gain_error(model: FittedModel) -> float:
    """Return the standard error of the logarithm of the gain."""
    return standard_errors(model.spectrum, model.covariance).log_gain


def _likely_gains(models: Sequence[FittedModel], error: float) -> tuple[float, float]:
    """Return the least and the largest gain of models, widened by the relative error of one."""
    logs = [model.spectrum.log_gain for model in models]
    margin = min(error, _GAIN_ERROR)
    return float(np.exp(min(logs) - margin)), float(np.exp(max(logs) + margin))


def refit_axis(
    axis: IdentifiedAxis, search: Search, error: float, note: str, *, moves: bool
) -> IdentifiedAxis:
    """Fit an axis again at the gain of a search, with its error; with ``moves``, lines may move."""
    model = search_model(search, axis.fitted_model.spectrum, moves=moves)
    return describe_axis(search, hold_gain(search, model, error), error, note)


def axis_periodogram(
    measurement: ArrayLike,
    correction: ArrayLike | None,
    frame_rate_hz: float,
    stretches: StretchesLike | None,
) -> LoopPeriodogram:
    """Return the periodogram of series that can be identified."""
    y = real_array(measurement, "measurement")
    if y.ndim != 1:
        raise DimensionError(f"measurement must be a series (frames,); got shape {y.shape}.")
    c = None if correction is None else real_array(correction, "correction")
    if c is not None and c.shape != y.shape:
        raise DimensionError(
            f"correction must have shape {y.shape} like measurement; got {c.shape}."
        )
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    pieces = checked_stretches(None if stretches is None else sorted(stretches), y.size)
    longest = max(stop - begin for begin, stop in pieces)
    if longest < 2 * SHORTEST_SEGMENT:
        raise ProblemError(
            f"a stretch of at least {2 * SHORTEST_SEGMENT} frames without a gap is needed; the "
            f"longest has {longest}. Record more, or bridge short gaps."
        )
    if all(np.ptp(y[begin:stop]) == 0 for begin, stop in pieces):
        raise ProblemError("the measurement is constant: there is nothing to identify.")
    with np.errstate(over="ignore", invalid="ignore"):
        data = loop_periodogram(y, c, frame_rate_hz=rate, stretches=pieces)
        finite = np.all(np.isfinite(data.power(1.0)))
    if not finite or np.min(data.measured) <= 0:
        raise ProblemError(
            "the spectrum of the series overflows or vanishes; got values up to "
            f"{np.max(np.abs(y)):.6g} nm. Check the units."
        )
    return data


def identify_spectrum(
    frequency_hz: ArrayLike,
    density_nm2_hz: ArrayLike,
    *,
    frame_rate_hz: float,
    averages: float | None = None,
    **options: Any,
) -> IdentifiedAxis:
    """Identify one axis from its one-sided density (f,) [nm^2/Hz] at even frequencies (f,) [Hz].

    The frequencies lie above 0 and below half the frame rate of the loop to come; the sensor gain
    of the result is 1. The density is the mean of ``averages`` independent periodograms, by default
    found from its scatter: one that scatters less than the mean of 1000 was smoothed, interpolated
    or computed, and counts as one. Options are ``announced``, ``lowest_line_hz`` and ``most_lines``
    of :func:`identify_axis`.
    """
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    f = real_array(frequency_hz, "frequency_hz")
    density = real_array(density_nm2_hz, "density_nm2_hz")
    if f.ndim != 1 or f.shape != density.shape or f.size < 32:
        raise DimensionError(
            "frequency_hz and density_nm2_hz must be lists of the same length, at least 32; got "
            f"{f.shape} and {density.shape}."
        )
    steps = np.diff(f)
    if np.any(steps <= 0) or f[0] <= 0 or f[-1] >= rate / 2:
        raise ProblemError(
            f"frequency_hz must increase from above 0 to below {rate / 2:.6g}; got {f[0]:.6g} to "
            f"{f[-1]:.6g}. Leave the mean out, and what lies above the Nyquist frequency."
        )
    if np.max(steps) > 1.01 * np.min(steps):
        raise ProblemError(
            f"frequency_hz must be evenly spaced; got steps of {np.min(steps):.6g} to "
            f"{np.max(steps):.6g}. Interpolate, or leave the odd part out."
        )
    if np.any(density <= 0):
        raise ProblemError(f"density_nm2_hz must be above 0; got {np.min(density):.6g}.")
    if averages is None:
        averages = estimate_averages(density) or 1.0
    zero = np.zeros_like(f)
    data = LoopPeriodogram(
        frequency_hz=f,
        measured=density,
        crossed=zero,
        corrected=zero,
        count=np.full(f.size, number(averages, "averages", above=0)),
        frame_rate_hz=rate,
        resolution_hz=float(np.median(steps)),
    )
    search = Search(data=data, gain=1.0, **options)
    note = "1: of a spectrum it has no meaning"
    return measure_separations(describe_axis(search, search_model(search), None, note))


def estimate_averages(density: FloatArray) -> float | None:
    """Return how many periodograms were averaged in a density, by its scatter about a curve.

    It is the shape of a gamma distribution. None above what anybody averages: otherwise each
    misfit would count as evidence for a line, and standard errors would vanish.
    """
    from scipy.optimize import brentq
    from scipy.special import polygamma
    from scipy.stats import median_abs_deviation

    log = np.log(density)
    # a second difference at a distance hardly sees a curve, and not what neighbours share
    bend = log[6:] - 2 * log[3:-3] + log[:-6]
    scatter = median_abs_deviation(bend, scale=0.6745) ** 2 / 6
    if scatter < polygamma(1, _MOST_AVERAGES):
        return None
    scatter = min(scatter, polygamma(1, _LEAST_AVERAGES))
    low, high = np.log(_LEAST_AVERAGES) - 1e-6, np.log(_MOST_AVERAGES) + 1e-6
    return float(np.exp(brentq(lambda x: polygamma(1, np.exp(x)) - scatter, low, high)))


def _compare_gains(
    search: Search, model: FittedModel, rivals: Sequence[FittedModel]
) -> tuple[FittedModel, list[FittedModel]]:
    """Return the likeliest model, and those of other gains that are nearly as likely.

    A plausible gain that is well known, without anything that could explain another one, has none.
    """
    spectrum = model.spectrum
    plain = all(line.is_narrow for line in spectrum.lines) and not spectrum.colour
    low, high = PLAUSIBLE_GAINS
    if plain and low <= spectrum.gain <= high and _gain_error(model) < _ROUGH_GAIN:
        return model, []
    return try_other_gains(search, model, rivals)
