"""The model of a loop from its record: both axes, with one sensor gain if they agree.

Doubts about a record: jumps, where series go on elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain, count
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.fit.axis import (
    axis_periodogram,
    estimate_averages,
    find_axis,
    identify_spectrum,
    refit_axis,
)
from lbt_synth.identification.fit.fitting import LOWEST_LINE_HZ, MOST_LINES, POSSIBLE_GAINS, Search
from lbt_synth.identification.fit.identified_model import (
    DIFFERENT,
    IdentifiedAxis,
    IdentifiedLine,
    IdentifiedModel,
)
from lbt_synth.identification.fit.line_drift import describe_drifts
from lbt_synth.identification.fit.periodogram import SHORTEST_SEGMENT, half_angle_square, tukey
from lbt_synth.identification.fit.physical_parameters import (
    describe_close_lines,
    measure_separations,
)
from lbt_synth.identification.fit.shared_lines import couple_axes
from lbt_synth.identification.records.line_priors import LinePrior
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord
from lbt_synth.identification.stretches import Stretches, StretchesLike, checked_stretches
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, IntArray, require_instance

_DELAY = 2.0  # frames, if neither the record nor the call has a delay
_CALIBRATED = 1.03  # largest gain of a sensor that was calibrated, to some percent
_UNSEEN = 0.5  # relative error of a noise that the rest of the spectrum hides
_UNSEEN_COLOUR = 0.045  # error of the correlation of a noise that may be coloured
_NOT_WHITE = 1e-3  # probability of white innovations below which a note says so
_LARGE = 12.0  # standard deviations of the change of a correction
_UNLIKELY = 8.0  # standard deviations of the innovations
_EDGE = 0.06  # of a stretch, at either end, where the taper hides jumps
_CLUSTER = 20  # frames within which outliers are one jump
_AROUND = 3  # frames left out on either side
_SAME_JUMP = 50  # frames within which the axes have one jump
_MOST_JUMPS = 20  # at which a record is cut


def identify(
    record: LoopRecord | SpectrumRecord,
    *,
    frame_rate_hz: float | None = None,
    delay_frames: float | None = None,
    sensor_gain: float | Sequence[float] | None = None,
    assumed_gain: float = 1.0,
    announced: Sequence[LinePrior] = (),
    lowest_line_hz: float = LOWEST_LINE_HZ,
    most_lines: int = MOST_LINES,
    stretches: StretchesLike | None = None,
    start: IdentifiedModel | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> IdentifiedModel:
    """Identify turbulence, vibrations, noise and sensor gain of a loop from its record.

    Each axis is identified separately (:func:`identify_axis`). A sensor usually has one gain for
    tip and tilt: gains that agree within three standard errors are averaged, and the rest is
    fitted again with the mean. An axis that does not show its gain takes that of the other.

    Parameters
    ----------
    record : LoopRecord or SpectrumRecord
        What the loop recorded, or spectra; in closed loop the delay must be known.
    frame_rate_hz : float, optional
        Frame rate of the loop to design for [Hz], for spectra without one.
    delay_frames : float, optional
        Total delay of that loop [frames], if the record does not have it; 2 by default.
    sensor_gain : float or one per axis, optional
        Known sensor gain; like ``assumed_gain``, ``stretches`` and ``start`` for series alone.
    assumed_gain, lowest_line_hz, most_lines
        As for :func:`identify_axis`.
    announced : sequence of LinePrior, optional
        Lines that are known beforehand, for instance from accelerometers.
    stretches : sequence of (start, stop), optional
        Frames to use; all that are usable by default.
    start : IdentifiedModel, optional
        A model to start from.
    progress : callable, optional
        Called with the number of fits done and their total.

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
    for line in announced:
        require_instance(line, LinePrior)
    if start is not None:
        require_instance(start, IdentifiedModel)
    options: dict[str, Any] = {
        "announced": [(line.frequency_hz, line.frequency_error_hz) for line in announced],
        "lowest_line_hz": lowest_line_hz,
        "most_lines": most_lines,
    }
    if isinstance(record, SpectrumRecord):
        _refuse_of_series(sensor_gain=sensor_gain, stretches=stretches, start=start)
        return _identify_spectra(record, frame_rate_hz, delay_frames, options)
    require_instance(record, LoopRecord)
    _check_record(record, frame_rate_hz, delay_frames, start)
    gains: list[float | None] = [None] * record.axes
    if sensor_gain is not None:
        gains = record.known_gains(sensor_gain).tolist()
    pieces = record.stretches() if stretches is None else _usable_stretches(stretches, record)
    fits, total = count(1), 3 * record.axes  # at first, after a jump, with the mean gain

    def step() -> None:
        if progress is not None:
            progress(next(fits), total)

    fit = partial(_fit_axes, record, step, options, assumed_gain)
    early = find_correction_jumps(record.corrections(), pieces)
    pieces, notes = cut_at_jumps(pieces, early, "commands")
    axes = fit(pieces, gains, [None] * record.axes if start is None else start.axes)
    series = record.pseudo_open_loop([axis.sensor_gain for axis in axes])
    late = find_jumps(series, axes, pieces)
    cut, late_notes = cut_at_jumps(pieces, late, "pseudo-open loop")
    if cut != pieces:
        axes = fit(cut, gains, axes)
    found_gain = [i for i, axis in enumerate(axes) if axis.sensor_gain_error is not None]
    notes += late_notes
    if len(axes) > 1 and found_gain and gains == [None] * len(axes):
        axes, note = _pool_gains(axes, found_gain, step, options)
        notes.append(note)
    shared: tuple[IdentifiedLine, ...] = ()
    if len(axes) == 2:
        axes, shared, more = couple_axes(record, axes, cut, lowest_line_hz)
        notes += more
    if not shared:
        axes = [measure_separations(axis) for axis in axes]
    notes += _find_doubts(axes, found_gain, most_lines)
    if progress is not None and next(fits) <= total:
        progress(total, total)
    model = IdentifiedModel(
        axes=tuple(axes),
        shared=shared,
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=next(d for d in (record.delay_frames, delay_frames, _DELAY) if d is not None),
        mirror=record.mirror,
        notes=tuple(notes),
    )
    return describe_drifts(model, record.pseudo_open_loop(model.sensor_gains), cut)


def _refuse_of_series(**options: object) -> None:
    """Refuse options with a spectrum that only series have."""
    for name, value in options.items():
        if value is not None:
            raise ProblemError(f"{name} is for series of a loop; a spectrum is of the phase.")


def _fit_axes(
    record: LoopRecord,
    step: Callable[[], None],
    options: dict[str, Any],
    assumed_gain: float,
    stretches: Stretches,
    gains: Sequence[float | None],
    starts: Sequence[IdentifiedAxis | None],
) -> list[IdentifiedAxis]:
    """Identify each axis, at its gain or at a free one, and from its start.

    ``options`` are those of a search.
    """
    axes = []
    each = zip(record.measurements.T, record.corrections().T, gains, starts, strict=True)
    for y, c, gain, start in each:
        data = axis_periodogram(y, c, record.frame_rate_hz, stretches)
        search = Search(data=data, gain=gain, **options)
        axes.append(find_axis(search, assumed_gain=assumed_gain, start=start))
        step()
    return axes


def _check_record(
    record: LoopRecord,
    frame_rate_hz: float | None,
    delay_frames: float | None,
    start: IdentifiedModel | None,
) -> None:
    """Refuse what contradicts a record, and a record that cannot be identified."""
    if frame_rate_hz is not None and frame_rate_hz != record.frame_rate_hz:
        raise ProblemError(
            f"the record has {record.frame_rate_hz:.9g} frames a second; got frame_rate_hz="
            f"{frame_rate_hz!r}. It is for spectra only."
        )
    delay = record.delay_frames
    if None not in (delay_frames, delay) and delay_frames != delay:
        raise ProblemError(
            f"the record has a delay of {delay:g} frames; got {delay_frames!r}. Try "
            "record.with_delay(...)."
        )
    record.corrections()  # refuses a closed loop without a delay
    if start is not None and len(start.axes) != record.axes:
        raise ProblemError(f"start must have {record.axes} axes; got {len(start.axes)}.")
    for i, series in enumerate(record.measurements[record.usable].T):
        if series.size and np.ptp(series) == 0:
            raise ProblemError(
                f"axis {i} of the record is constant: there is nothing to identify. Choose the "
                "other axis."
            )


def _usable_stretches(stretches: StretchesLike, record: LoopRecord) -> Stretches:
    """Return given stretches in order; refuse those with frames that are not usable."""
    out = checked_stretches(sorted(stretches), record.frames)
    for a, b in out:
        if not np.all(record.usable[a:b]):
            raise ProblemError(f"stretches must lie within the usable frames; got ({a}, {b}).")
    return out


def _pool_gains(
    axes: list[IdentifiedAxis],
    found_gain: list[int],
    step: Callable[[], None],
    options: dict[str, Any],
) -> tuple[list[IdentifiedAxis], str]:
    """Fit the axes again with the mean of the gains that were found, if they agree.

    An axis whose gain was found has its lines where they are. ``options`` are those of a search.
    Where the gains scatter by more than their errors, the error of the mean is scaled by
    ``sqrt(chi^2 / (n - 1))`` (Particle Data Group, doi:10.1093/ptep/ptac097, section 5.2.2).
    """
    gains = np.array([axes[i].sensor_gain for i in found_gain])
    errors = np.array([axes[i].sensor_gain_error for i in found_gain], dtype=float)
    log, weight = np.log(gains), (gains / errors) ** 2
    mean = float(np.sum(weight * log) / np.sum(weight))
    if np.any(np.abs(log - mean) * gains > DIFFERENT * errors):
        values = ", ".join(f"{g:.3f} +- {e:.3f}" for g, e in zip(gains, errors, strict=True))
        return axes, (
            f"warning: the axes have different sensor gains, {values}: the commands of one may be "
            "recorded at another size (--command-scale takes a factor for each axis)"
        )
    scatter = float(np.sum(weight * (log - mean) ** 2)) / max(len(found_gain) - 1, 1)
    gain, error = float(np.exp(mean)), float(np.sqrt(max(scatter, 1.0) / np.sum(weight)))
    alone = len(found_gain) < len(axes)
    own = "found in the closed loop's data" if alone else "mean of the axes"
    pooled = []
    for i, axis in enumerate(axes):
        search, found = Search(data=axis.data, gain=gain, **options), i in found_gain
        note = own if found else "that of the other axis"
        pooled.append(refit_axis(axis, search, error, note, moves=not found))
        step()
    return pooled, "one sensor gain for all axes"


def _doubt_scale(axes: Sequence[IdentifiedAxis]) -> Iterator[str]:
    """Yield that gains above 1 may be those of commands recorded at a fraction of their size."""
    above = {
        f"{axis.sensor_gain:.3f} +- {axis.sensor_gain_error:.3f}"
        for axis in axes
        if axis.sensor_gain_error is not None
        and _CALIBRATED + DIFFERENT * axis.sensor_gain_error < axis.sensor_gain < POSSIBLE_GAINS[1]
    }
    if above:
        yield (
            f"warning: a calibrated sensor has a gain of at most 1; here it is "
            f"{' and '.join(sorted(above))}. Commands recorded at a fraction of what was applied "
            "look like that (--command-scale 2 if at half)"
        )


def _find_doubts(
    axes: Sequence[IdentifiedAxis], found_gain: Sequence[int], most_lines: int
) -> Iterator[str]:
    """Yield notes on odd gains, hidden noise, close and too many lines, and what no model has."""
    for i in found_gain:
        if not POSSIBLE_GAINS[0] < axes[i].sensor_gain < POSSIBLE_GAINS[1]:
            yield (
                f"warning: axis {i} has a sensor gain of {axes[i].sensor_gain:.3g}: are the units, "
                "signs and axes of the commands right?"
            )
    yield from _doubt_scale([axes[i] for i in found_gain])
    for i, axis in enumerate(axes):
        if axis.noise_error_nm > _UNSEEN * axis.noise_nm:
            yield f"warning: the noise of axis {i} is not seen under the rest of its spectrum"
    for i, axis in enumerate(axes):
        if sum(part.kind != "turbulence" for part in axis.parts) >= most_lines > 0:
            yield (
                f"the limit of {most_lines} lines was reached on axis {i}: there may be more, and "
                "the rest of the model suffers"
            )
    for i, axis in enumerate(axes):
        yield from describe_close_lines(axis, i)
    for i, axis in enumerate(axes):
        if axis.noise_correlation:
            yield (
                f"the noise of axis {i} is not white: neighbouring frames have a correlation of "
                f"{axis.noise_correlation:.3f} +- {axis.noise_correlation_error:.3f}, which the "
                "model and its errors hold. Designs take white noise of the same rms"
            )
        elif i in found_gain and axis.noise_correlation_error > _UNSEEN_COLOUR:
            yield (
                f"warning: the record does not show whether the noise of axis {i} is white (its "
                f"correlation is 0 +- {axis.noise_correlation_error:.2g}): noise, sensor gain and "
                "their errors hold if it is"
            )
    for i, axis in enumerate(axes):
        test = axis.whiteness
        if test.p_value < _NOT_WHITE or test.correlation_p_value < _NOT_WHITE:
            yield (
                f"warning: the innovations of axis {i} are not white (p = {test.p_value:.2g}, "
                f"{test.correlation_p_value:.2g}): the model leaves something out, such as noise "
                "that is not white. The standard errors do not cover that, and the sensor gain may "
                "be wrong by many of them"
            )


def _identify_spectra(
    record: SpectrumRecord,
    frame_rate_hz: float | None,
    delay_frames: float | None,
    options: dict[str, Any],
) -> IdentifiedModel:
    """Identify each spectrum, between 0 and the Nyquist frequency of the loop."""
    rate = frame_rate_hz if frame_rate_hz is not None else record.frame_rate_hz
    if rate is None:
        raise ProblemError(
            "the frame rate of the loop is needed to sample a spectrum's processes; got a record "
            "without one. Give frame_rate_hz."
        )
    inside = (record.frequency_hz > 0) & (record.frequency_hz < rate / 2)
    f, densities = record.frequency_hz[inside], record.density_nm2_hz[inside].T
    options |= {"frame_rate_hz": rate, "averages": record.averages}
    axes = [identify_spectrum(f, density, **options) for density in densities]
    left = int(np.sum(record.frequency_hz >= rate / 2))
    notes = [f"{left} frequencies beyond {rate / 2:g} Hz were left out"] if left else []
    notes += [
        f"the density of axis {i} does not scatter as periodograms do (smoothed, interpolated "
        "or computed?) and was taken for one of them. Give averages to find weaker lines"
        for i, density in enumerate(densities)
        if record.averages is None and estimate_averages(density) is None
    ]
    return IdentifiedModel(
        axes=tuple(axes),
        frame_rate_hz=rate,
        delay_frames=_DELAY if delay_frames is None else delay_frames,
        notes=tuple(notes),
    )


Jump = tuple[int, float]  # frame where a series goes on elsewhere, standard deviations of that


def find_jumps(
    series: FloatArray, axes: Sequence[IdentifiedAxis], stretches: Stretches
) -> list[Jump]:
    """Find where the innovations of pseudo-open-loop series (frames, axes) are far too large."""
    each = zip(series.T, axes, strict=True)
    return _merge_jumps([jump for one, axis in each for jump in _axis_jumps(one, axis, stretches)])


def _axis_jumps(series: FloatArray, axis: IdentifiedAxis, stretches: Stretches) -> list[Jump]:
    """Find the jumps of one axis, in differences over the root of the fitted spectrum."""
    out: list[Jump] = []
    log_f, log_density = np.log(axis.frequency_hz), np.log(axis.fitted_nm2_hz)
    for start, stop in stretches:
        count = stop - start - 1
        if count < SHORTEST_SEGMENT:
            continue
        transform = np.fft.rfft(tukey(count) * np.diff(series[start:stop]))
        f: FloatArray = np.arange(1.0, transform.size) * (axis.frame_rate_hz / count)
        density = np.exp(np.interp(np.log(f), log_f, log_density))
        power = density * half_angle_square(f, axis.frame_rate_hz) * axis.frame_rate_hz / 2
        transform[0] = 0
        transform[1:] /= np.sqrt(power)
        size = np.abs(np.fft.irfft(transform, count))
        edge = int(_EDGE * count)
        scale = float(np.median(size)) / 0.6745
        far = edge + np.flatnonzero(size[edge : count - edge] > _UNLIKELY * scale)
        out += _largest_of_clusters(size / scale, far, start)
    return out


def find_correction_jumps(corrections: FloatArray, stretches: Stretches) -> list[Jump]:
    """Find where the corrections (frames, axes) go on elsewhere.

    A fit would choose a sensor gain at which a jump of the commands does not show: they are
    looked for before anything is fitted.
    """
    inside = np.zeros(len(corrections) - 1, dtype=np.bool_)
    for start, stop in stretches:
        inside[start : stop - 1] = True
    out: list[Jump] = []
    for change in np.abs(np.diff(corrections, axis=0)).T:
        scale = float(np.median(change[inside])) / 0.6745 if inside.any() else 0.0
        if scale > 0:
            far = np.flatnonzero(inside & (change > _LARGE * scale))
            out += _largest_of_clusters(change / scale, far, 0)
    return _merge_jumps(out)


def _largest_of_clusters(size: FloatArray, far: IntArray, start: int) -> list[Jump]:
    """Return the largest of each cluster of differences that are too large."""
    out = []
    for place in np.split(far, 1 + np.flatnonzero(np.diff(far) > _CLUSTER)):
        if place.size:
            best = int(place[np.argmax(size[place])])
            out.append((start + 1 + best, float(size[best])))
    return out


def _merge_jumps(found: Sequence[Jump]) -> list[Jump]:
    """Return jumps by rising frame, each place once."""
    out: list[Jump] = []
    for jump in sorted(found, key=lambda jump: jump[0]):
        if not out or jump[0] - out[-1][0] > _SAME_JUMP:
            out.append(jump)
    return out


def cut_at_jumps(
    stretches: Stretches, jumps: Sequence[Jump], series: str
) -> tuple[Stretches, list[str]]:
    """Return stretches without the neighbourhood of the jumps of some series, and a note.

    Nothing is cut if there are too many jumps.
    """
    if not jumps:
        return stretches, []
    frame, size = max(jumps, key=lambda jump: jump[1])
    note = (
        f"warning: {count_text(len(jumps), 'jump')} of the {series}, the largest "
        f"at frame {frame} with {size:.0f} standard deviations"
    )
    if len(jumps) > _MOST_JUMPS:
        return stretches, [f"{note}; too many to cut the record there, and the model suffers"]
    cut = cut_around(stretches, [frame for frame, _ in jumps])
    return cut, [f"{note}; the record was cut there"]


def cut_around(stretches: Stretches, frames: Sequence[int]) -> Stretches:
    """Return stretches without the neighbourhood of some frames."""
    for frame in frames:
        low, high = frame - _AROUND, frame + _AROUND
        pieces = chain(*(((a, min(b, low)), (max(a, high), b)) for a, b in stretches))
        stretches = tuple((a, b) for a, b in pieces if b > a)
    return stretches
