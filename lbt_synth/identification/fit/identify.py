"""The model of a loop from its record: each axis, then both with one sensor gain if they agree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.fit.fitting import (
    GAIN_ERROR,
    LOWEST_LINE_HZ,
    MOST_LINES,
    POSSIBLE_GAINS,
    Search,
    add_evidence,
)
from lbt_synth.identification.fit.identified_model import (
    DIFFERENT,
    IdentifiedAxis,
    IdentifiedLine,
    IdentifiedModel,
    describe_axis,
    hold_gain,
)
from lbt_synth.identification.fit.order_search import find_components, find_models
from lbt_synth.identification.fit.periodogram import (
    SHORTEST_SEGMENT,
    LoopPeriodogram,
    loop_periodogram,
)
from lbt_synth.identification.fit.shared_lines import couple_axes
from lbt_synth.identification.records.faults import MAD, RARE
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord, Stretches
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, each_of, require_instance

_DELAY = 2.0  # frames, of a spectrum or an open loop without a delay
_CALIBRATED = 1.03  # largest gain of a sensor that was calibrated, to some percent
_UNSEEN = 0.5  # relative error of a noise that the rest of the spectrum hides
_UNSEEN_COLOUR = 0.045  # error of the correlation of a noise that may be coloured
OPEN_GAIN = 0.3  # relative error of a gain that a record leaves open
_POOR_GAIN = 0.1  # relative error from which a note says so, and no later fit begins there
_JUMP = 8.0  # standard deviations of the change of a correction: no loop makes it
_AROUND_JUMP = 25  # frames left out on either side: what is nearer is the same jump
_MOST_JUMPS = 20  # at which a record is cut
_MOST_AVERAGES = 1000.0  # of the periodograms in a density: nobody takes more


def identify(
    record: LoopRecord | SpectrumRecord,
    *,
    frame_rate_hz: float | None = None,
    delay_frames: float | None = None,
    sensor_gain: float | Sequence[float] | None = None,
    noise_nm: float | Sequence[float] | None = None,
    lowest_line_hz: float = LOWEST_LINE_HZ,
    most_lines: int = MOST_LINES,
    start: IdentifiedModel | None = None,
) -> IdentifiedModel:
    """Identify turbulence, vibrations, noise and sensor gain of a loop from its record.

    The pseudo-open-loop measurement ``y(k) + g c(k)`` of an axis, with c(k) the correction that
    y(k) contains and g the sensor gain, is g times the phase plus the noise. Its spectrum is the
    sum of turbulence (a second-order process, with the roll-off of tilt if the data ask for it),
    resonances and noise: white, or a first-order process where the data ask for it. The Whittle
    likelihood chooses all parameters, the sensor gain among them, and a penalised criterion the
    number of resonances. A sensor usually has one gain for tip and tilt: gains that agree within
    three standard errors are averaged, and the rest is fitted again with the mean. Before the data
    say more, a gain is taken to be 0.7, within a factor of 1.6.

    Parameters
    ----------
    record : LoopRecord or SpectrumRecord
        What the loop recorded, or spectra; in closed loop the delay must be known.
    frame_rate_hz, delay_frames : float, optional
        Frame rate [Hz] and total delay [frames], 2 by default, of the loop to design for; for
        spectra alone.
    sensor_gain : float or one per axis, optional
        Known sensor gain; like ``start`` for series alone.
    noise_nm : float or one per axis, optional
        Noise per frame of the sensor of that loop [nm], for spectra alone: those of wind shake or
        of a simulation have none.
    lowest_line_hz : float, optional
        A resonance below is a part of the turbulence [Hz].
    most_lines : int, optional
        Most resonances above it on each axis.
    start : IdentifiedModel, optional
        A model to start from.

    Returns
    -------
    IdentifiedModel
        The axes with standard errors; ``plant()`` is what :func:`kalman` takes.

    Raises
    ------
    ProblemError
        If a value is out of range, the delay is missing, or the record is too short.
    NumericalError
        If a fit fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.005, rms_nm=30)
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> loop = lbt.integrator(path, gain=0.4)
    >>> run = lbt.simulate(loop.controller, truth, hardware=path, frames=20_000)
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> found = lbt.identify(record)
    >>> [[round(line.frequency_hz) for line in axis.lines] for axis in found.axes]
    [[40], []]
    >>> lbt.kalman(found.plant()).certificate.passed
    True
    """
    options: dict[str, Any] = {"lowest_line_hz": lowest_line_hz, "most_lines": most_lines}
    of_series = {"sensor_gain": sensor_gain, "start": start}
    loop = {"frame_rate_hz": frame_rate_hz, "delay_frames": delay_frames}
    if isinstance(record, SpectrumRecord):
        if names := [name for name, value in of_series.items() if value is not None]:
            raise ProblemError(f"{names[0]} is for series of a loop; a spectrum is of the phase.")
        return _identify_spectra(record, noise_nm, options, **loop)
    require_instance(record, LoopRecord)
    of_spectra = {"noise_nm": noise_nm, **loop}
    if names := [name for name, value in of_spectra.items() if value is not None]:
        raise ProblemError(f"{names[0]} is for spectra; a series has its own.")
    if start is not None:
        require_instance(start, IdentifiedModel)
        if len(start.axes) != record.axes:
            raise ProblemError(f"start must have {record.axes} axes; got {len(start.axes)}.")
    gains: list[float | None] = [None] * record.axes
    if sensor_gain is not None:
        gains = record.known_gains(sensor_gain).tolist()
    pieces, notes = _cut_at_jumps(record.corrections(), record.stretches())
    starts: Sequence[IdentifiedAxis | None] = start.axes if start else [None] * record.axes
    series = zip(record.measurements.T, record.corrections().T, gains, starts, strict=True)
    axes = list[IdentifiedAxis]()
    for y, c, gain, axis_start in series:
        data = axis_periodogram(y, c, record.frame_rate_hz, pieces)
        axes.append(find_axis(Search(data=data, gain=gain, **options), start=axis_start))
    if len(axes) > 1 and all(axis.sensor_gain_error is not None for axis in axes):
        axes, note = _pool_gains(axes, options)
        notes.append(note)
    shared: tuple[IdentifiedLine, ...] = ()
    if len(axes) == 2:
        axes, shared = couple_axes(record, axes, pieces, lowest_line_hz)
    return IdentifiedModel(
        axes=tuple(axes),
        shared=shared,
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=record.delay_frames or _DELAY,
        mirror=record.mirror,
        notes=tuple(dict.fromkeys([*notes, *_find_doubts(axes, most_lines)])),
    )


def _cut_at_jumps(corrections: FloatArray, stretches: Stretches) -> tuple[Stretches, list[str]]:
    """Return stretches without the places where corrections go on elsewhere, and a note."""
    change = np.abs(np.diff(corrections, axis=0))
    inside = np.zeros(len(change), dtype=np.bool_)
    for start, stop in stretches:
        inside[start : stop - 1] = True
    scale = MAD * np.median(change[inside], axis=0)
    deviations = np.max(change[:, scale > 0] / scale[scale > 0], axis=1, initial=0.0) * inside
    places = np.flatnonzero(deviations > _JUMP)
    if not places.size:
        return stretches, []
    jumps = np.split(places, 1 + np.flatnonzero(np.diff(places) > _AROUND_JUMP))
    note = (
        f"warning: {count_text(len(jumps), 'jump')} of the commands, the largest at frame "
        f"{1 + int(np.argmax(deviations))} with {np.max(deviations):.0f} standard deviations"
    )
    if len(jumps) > _MOST_JUMPS:
        return stretches, [f"{note}; too many to cut the record there, and the model suffers"]
    for jump in jumps:
        low, high = int(jump[0]) + 1 - _AROUND_JUMP, int(jump[-1]) + 1 + _AROUND_JUMP
        pieces = chain(*(((a, min(b, low)), (max(a, high), b)) for a, b in stretches))
        stretches = tuple((a, b) for a, b in pieces if b > a)
    return stretches, [f"{note}; the record was cut there"]


def _pool_gains(
    axes: list[IdentifiedAxis], options: dict[str, Any]
) -> tuple[list[IdentifiedAxis], str]:
    """Fit the axes again with the mean of their gains, if they agree; options are of a search."""
    gains = np.array([axis.sensor_gain for axis in axes])
    errors = np.array([axis.sensor_gain_error for axis in axes], dtype=float)
    log, weight = np.log(gains), (gains / errors) ** 2
    # an axis that leaves its gain open takes that of the other
    weight[errors > OPEN_GAIN * gains] *= bool(np.all(errors > OPEN_GAIN * gains))
    mean = float(np.sum(weight * log) / np.sum(weight))
    if np.any(weight * (log - mean) ** 2 > DIFFERENT**2):
        values = ", ".join(f"{g:.3f} +- {e:.3f}" for g, e in zip(gains, errors, strict=True))
        return axes, (
            f"warning: the axes have different sensor gains, {values}: the commands of one may be "
            "recorded at another size (--command-scale takes a factor for each axis)"
        )
    # Particle Data Group, doi:10.1093/ptep/ptac097, section 5.2.2: errors times sqrt(chi^2/(n-1))
    scatter = float(np.sum(weight * (log - mean) ** 2)) / (len(axes) - 1)
    # what is known of a gain beforehand counts once
    precision = float(np.sum(weight)) - (len(axes) - 1) / GAIN_ERROR**2
    gain = float(np.exp(mean))
    error = float(np.sqrt(max(scatter, 1.0) / max(precision, 1 / GAIN_ERROR**2)))
    note = _gain_note(error, "mean of the axes")
    pooled = [
        refit_axis(axis, Search(data=axis.data, gain=gain, **options), error, note) for axis in axes
    ]
    return pooled, "one sensor gain for all axes"


def _find_doubts(axes: Sequence[IdentifiedAxis], most_lines: int) -> Iterator[str]:
    """Yield notes on odd gains, hidden noise, too many lines, and what no model has."""
    lowest, _ = POSSIBLE_GAINS
    for i, axis in enumerate(axes):
        gain, error, test = axis.sensor_gain, axis.sensor_gain_error, axis.whiteness
        if error is not None and not lowest < gain < _CALIBRATED + DIFFERENT * error:
            yield (
                f"warning: a sensor has a gain of {lowest:g} to 1; here it is {gain:.3g} +- "
                f"{error:.2g}. Are the units, signs and axes of the commands right? Those recorded "
                "at a fraction of what was applied look like that (--command-scale 2 if at half)"
            )
        if axis.noise_error_nm > _UNSEEN * axis.noise_nm:
            yield f"warning: the noise of axis {i} is not seen under the rest of its spectrum"
        if sum(resonance.kind != "turbulence" for resonance in axis.parts) >= most_lines > 0:
            yield (
                f"the limit of {most_lines} lines was reached on axis {i}: there may be more, and "
                "the rest of the model suffers"
            )
        if axis.noise_correlation:
            yield (
                f"the noise of axis {i} is not white: neighbouring frames have a correlation of "
                f"{axis.noise_correlation:.3f} +- {axis.noise_correlation_error:.3f}, which the "
                "model and its errors hold. Designs take white noise of the same rms"
            )
        elif error is not None and axis.noise_correlation_error > _UNSEEN_COLOUR:
            yield (
                f"warning: the record does not show whether the noise of axis {i} is white (its "
                f"correlation is 0 +- {axis.noise_correlation_error:.2g}): noise, sensor gain and "
                "their errors hold if it is"
            )
        if test.p_value < RARE:
            yield (
                f"warning: the innovations of axis {i} are not white (p = {test.p_value:.2g}): "
                "the model leaves something out, such as noise that is not white. The standard "
                "errors do not cover that, and the sensor gain may be wrong by many of them"
            )


def _identify_spectra(
    record: SpectrumRecord,
    noise_nm: float | Sequence[float] | None,
    options: dict[str, Any],
    *,
    frame_rate_hz: float | None,
    delay_frames: float | None,
) -> IdentifiedModel:
    """Identify each spectrum, between 0 and the Nyquist frequency of the loop."""
    rate = frame_rate_hz if frame_rate_hz is not None else record.frame_rate_hz
    if rate is None:
        raise ProblemError(
            "the frame rate of the loop is needed to sample a spectrum's processes; got a record "
            "without one. Give frame_rate_hz."
        )
    stated = None if noise_nm is None else each_of(noise_nm, "noise_nm", record.axes, above=0)
    inside = (record.frequency_hz > 0) & (record.frequency_hz < rate / 2)
    f, densities = record.frequency_hz[inside], record.density_nm2_hz[inside].T
    if f.size < 32:
        raise DimensionError(
            "a spectrum must have at least 32 frequencies above 0 and below half the frame rate, "
            f"{rate / 2:.6g} Hz; got {f.size}."
        )
    steps = np.diff(f)
    if np.max(steps) > 1.01 * np.min(steps):
        raise ProblemError(
            f"frequency_hz must be evenly spaced; got steps of {np.min(steps):.6g} to "
            f"{np.max(steps):.6g}. Interpolate, or leave the odd part out."
        )
    if np.any(densities <= 0):
        raise ProblemError(f"density_nm2_hz must be above 0; got {np.min(densities):.6g}.")
    beyond = int(np.sum(record.frequency_hz >= rate / 2))
    cut = f"{count_text(beyond, 'frequency', 'frequencies')} beyond {rate / 2:g} Hz"
    notes = [f"{cut} {'was' if beyond == 1 else 'were'} left out"] if beyond else []
    axes, zero = [], np.zeros_like(f)
    for i, density in enumerate(densities):
        averages = record.averages or _estimate_averages(density)
        if averages is None:
            notes.append(
                f"the density of axis {i} does not scatter as periodograms do (smoothed, "
                "interpolated or computed?) and was taken for one of them. Give averages to find "
                "weaker lines"
            )
        data = LoopPeriodogram(
            frequency_hz=f,
            measured=density,
            crossed=zero,
            corrected=zero,
            count=zero + (averages or 1.0),
            frame_rate_hz=rate,
        )
        search = Search(data=data, gain=1.0, **options)
        model = add_evidence(search, find_components(search))
        axis = describe_axis(search, model, None, "1: of a spectrum it has no meaning")
        if stated is not None:
            axis = replace(axis, noise_nm=float(stated[i]), noise_error_nm=0.0)
        axes.append(axis)
    return IdentifiedModel(
        axes=tuple(axes),
        frame_rate_hz=rate,
        delay_frames=_DELAY if delay_frames is None else delay_frames,
        notes=tuple(notes),
    )


def _estimate_averages(density: FloatArray) -> float | None:
    """Return how many periodograms were averaged in a density, by its scatter about a curve."""
    log = np.log(density)
    # a second difference at a distance hardly sees a curve, and not what neighbours share
    bend = log[6:] - 2 * log[3:-3] + log[:-6]
    variance = (MAD * float(np.median(np.abs(bend - np.median(bend))))) ** 2 / 6
    if variance < 1 / _MOST_AVERAGES:  # each misfit would count as evidence for a line
        return None
    # of the logarithm of a mean of n it is 1 / n + 1 / (2 n^2), nearly
    return float((1 + np.sqrt(1 + 2 * variance)) / (2 * variance))


def find_axis(search: Search, *, start: IdentifiedAxis | None = None) -> IdentifiedAxis:
    """Identify one axis from its periodogram, and from a model of earlier data.

    A model whose gain is poorly known is none to start from: another gain may explain as much.
    """
    spectrum = None
    if start is not None and (start.sensor_gain_error or 0.0) < _POOR_GAIN * start.sensor_gain:
        spectrum = start.fitted_model.spectrum
    model, near = find_models(search, spectrum)
    model = add_evidence(search, model)
    if not search.finds_gain:
        note = "given" if search.data.closed else "given: the series is divided by it"
        if search.gain is None:
            note = "1: of an open loop it has no meaning"
        return describe_axis(search, model, None, note)
    background = model.spectrum.background
    rivals = [rival.spectrum.background for rival in near]
    fit_error = model.errors.background.log_gain
    error = max(fit_error, *(abs(rival.log_gain - background.log_gain) for rival in rivals))
    if error > fit_error:  # what the gain moves is as ambiguous
        model = hold_gain(search, model, [([0], error)])
    colours = np.tanh([background.colour, *(rival.colour for rival in rivals)])
    note = _gain_note(error, "found in the closed loop's data")
    return describe_axis(search, model, error, note, colour_error=float(np.ptp(colours)))


def _gain_note(error: float, origin: str) -> str:
    """Say where a gain comes from, and how well it is known."""
    if error < _POOR_GAIN:
        return origin
    if error < OPEN_GAIN:
        return f"{origin}, to {100 * error:.0f} % only"
    return (
        f"{origin}, which leave it open by {100 * error:.0f} % (the loop hardly acts where the "
        "noise shows). Give it, or record with a higher loop gain"
    )


def refit_axis(axis: IdentifiedAxis, search: Search, error: float, note: str) -> IdentifiedAxis:
    """Fit an axis again at the gain of a search, with its error."""
    model = add_evidence(search, find_components(search, axis.fitted_model.spectrum))
    return describe_axis(search, hold_gain(search, model, [([0], error)]), error, note)


def axis_periodogram(
    y: FloatArray, c: FloatArray | None, frame_rate_hz: float, pieces: Stretches
) -> LoopPeriodogram:
    """Return the periodogram of measurements and corrections (frames,) of one axis."""
    longest = max((stop - begin for begin, stop in pieces), default=0)
    if longest < 2 * SHORTEST_SEGMENT:
        raise ProblemError(
            f"a stretch of at least {2 * SHORTEST_SEGMENT} frames without a gap is needed; the "
            f"longest has {longest}. Record more, or bridge short gaps."
        )
    if all(np.ptp(y[begin:stop]) == 0 for begin, stop in pieces):
        raise ProblemError(
            "a measurement is constant: there is nothing to identify. Choose the other axis."
        )
    with np.errstate(over="ignore", invalid="ignore"):
        data = loop_periodogram(y, c, frame_rate_hz=frame_rate_hz, stretches=pieces)
        finite = np.all(np.isfinite(data.power(1.0)))
    if not finite or np.min(data.measured) <= 0:
        raise ProblemError(
            "the spectrum of the series overflows or vanishes; got values up to "
            f"{np.max(np.abs(y)):.6g} nm. Check the units."
        )
    return data
