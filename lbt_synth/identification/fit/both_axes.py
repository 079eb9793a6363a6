"""Both axes of a loop, with one sensor gain where the data agree on one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.fit.axis import (
    LOWEST_LINE_HZ,
    MOST_LINES,
    estimate_averages,
    identify_axis,
    identify_spectrum,
)
from lbt_synth.identification.fit.identified_model import IdentifiedAxis, IdentifiedModel
from lbt_synth.identification.fit.jumps import (
    Jump,
    better_delay,
    cut_around,
    find_correction_jumps,
    find_jumps,
)
from lbt_synth.identification.records.line_priors import LinePrior
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.records.spectrum import SpectrumRecord
from lbt_synth.validation import instance

_DELAY = 2.0  # frames, where nothing is said
_MOST_JUMPS = 20
_LEAST_GAIN, _MOST_GAIN = 0.04, 2.5  # that a sensor has
_SAME_JUMP = 50  # frames
_UNSEEN = 0.5
_APART = 3.0  # standard errors between gains that are not the same


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
    stretches: Sequence[tuple[int, int]] | None = None,
    start: IdentifiedModel | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> IdentifiedModel:
    """Identify turbulence, vibrations, noise and sensor gain of a loop from its record.

    Each axis by itself, see :func:`identify_axis`. A sensor has one gain for tip and tilt as a
    rule: gains that agree within three standard errors are averaged, and all the rest is fitted
    again with the mean; an axis that does not show its gain takes that of the other.

    Parameters
    ----------
    record : LoopRecord or SpectrumRecord
        What the loop recorded, in closed or open loop, or spectra; the delay must be known in
        closed loop.
    frame_rate_hz : float, optional
        Frame rate of the loop to come [Hz], where the record is of spectra and does not tell it.
    delay_frames : float, optional
        Total delay of the loop to come [frames], where the record does not tell it; 2 by default.
    sensor_gain : float or one an axis, optional
        Sensor gain, if it is known.
    assumed_gain : float, optional
        What to take where the data do not tell.
    announced : sequence of LinePrior, optional
        Lines that are known beforehand, from accelerometers for instance.
    lowest_line_hz : float, optional
        A resonance below is a part of the turbulence [Hz].
    most_lines : int, optional
        Number of resonances above it, for an axis at most.
    stretches : sequence of (start, stop), optional
        Frames to use; all that are usable by default.
    start : IdentifiedModel, optional
        A result to begin with.
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
        instance(line, LinePrior)
    known = [(line.frequency_hz, line.frequency_error_hz) for line in announced]
    if start is not None:
        instance(start, IdentifiedModel)
    options: dict[str, Any] = {
        "announced": known,
        "lowest_line_hz": lowest_line_hz,
        "most_lines": most_lines,
    }
    if isinstance(record, SpectrumRecord):
        return _identify_spectra(record, frame_rate_hz, delay_frames, options)
    instance(record, LoopRecord)
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
    count = record.axes
    if start is not None and len(start.axes) != count:
        raise ProblemError(f"start must have {count} axes; got {len(start.axes)}.")
    gains = _gain_per_axis(sensor_gain, count)
    corrections = None
    if record.commands is not None:
        if delay is None:
            raise ProblemError(
                "the delay of a closed loop is needed to know what the mirror did; got a record "
                "without one. Try record.with_delay(...)."
            )
        corrections = record.corrections()
    pieces = list(record.stretches() if stretches is None else _check_stretches(stretches, record))
    dead = [i for i in range(count) if np.ptp(record.measurements[record.usable, i]) == 0]
    if dead and record.usable.any():
        raise ProblemError(
            f"axis {dead[0]} of the record is constant: there is nothing to identify. Choose the "
            "other axis."
        )
    total, done = 2 * count, 0

    def one(
        i: int, gain: float | None, begin: IdentifiedAxis | None, error: float = 0.0
    ) -> IdentifiedAxis:
        nonlocal done
        found = identify_axis(
            record.measurements[:, i],
            None if corrections is None else corrections[:, i],
            frame_rate_hz=record.frame_rate_hz,
            stretches=pieces,
            sensor_gain=gain,
            sensor_gain_error=error,
            assumed_gain=assumed_gain,
            start=begin,
            **options,
        )
        done += 1
        if progress is not None:
            progress(done, total)
        return found

    notes: list[str] = []
    if corrections is not None:
        early = merge_jumps(
            [
                jump
                for i in range(count)
                for jump in find_correction_jumps(corrections[:, i], pieces)
            ]
        )
        if early:
            notes.append(_describe_jumps(early, "commands"))
            pieces = _cut_at_jumps(pieces, early)
    axes = [one(i, gains[i], None if start is None else start.axes[i]) for i in range(count)]
    broken = _find_jumps(record, axes, pieces)
    if broken:
        notes.append(_describe_jumps(broken, "pseudo-open loop"))
        if len(broken) <= _MOST_JUMPS:
            pieces = _cut_at_jumps(pieces, broken)
            axes = [one(i, gains[i], axes[i]) for i in range(count)]
    told = [i for i in range(count) if axes[i].sensor_gain_error is not None]
    if count > 1 and told and all(gain is None for gain in gains):
        axes, note = _pool_gains(axes, told, one)
        notes.append(note)
    notes += _find_doubts(record, axes, told, pieces)
    notes += [
        f"the limit of {most_lines} lines was reached on axis {i}: there may be more, and the "
        "rest of the model suffers"
        for i, axis in enumerate(axes)
        if sum(part.kind != "turbulence" for part in axis.parts) >= most_lines > 0
    ]
    if progress is not None and done < total:
        progress(total, total)
    return IdentifiedModel(
        axes=tuple(axes),
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=next(d for d in (delay, delay_frames, _DELAY) if d is not None),
        mirror=record.mirror,
        notes=tuple(notes),
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
    f = record.frequency_hz
    inside = (f > 0) & (f < rate / 2)
    axes = [
        identify_spectrum(
            f[inside], column[inside], frame_rate_hz=rate, averages=record.averages, **options
        )
        for column in record.density_nm2_hz.T
    ]
    left = int(np.sum(f >= rate / 2))
    notes = [f"{left} frequencies beyond {rate / 2:g} Hz were left out"] if left else []
    if record.averages is None:
        notes += [
            f"the density of axis {i} does not scatter as periodograms do (smoothed, interpolated "
            "or computed?) and was taken for one of them. Give averages to find weaker lines"
            for i, column in enumerate(record.density_nm2_hz.T)
            if estimate_averages(column[inside]) is None
        ]
    return IdentifiedModel(
        axes=tuple(axes),
        frame_rate_hz=rate,
        delay_frames=_DELAY if delay_frames is None else delay_frames,
        notes=tuple(notes),
    )


def _check_stretches(
    stretches: Sequence[tuple[int, int]], record: LoopRecord
) -> list[tuple[int, int]]:
    """Return stretches that lie apart and hold usable frames only."""
    out = sorted((int(a), int(b)) for a, b in stretches)
    for i, (a, b) in enumerate(out):
        after = out[i - 1][1] if i else 0
        if not after <= a < b <= record.frames or not np.all(record.usable[a:b]):
            raise ProblemError(
                f"stretches must lie apart and within the usable frames; got ({a}, {b})."
            )
    return out


def _find_jumps(
    record: LoopRecord, axes: Sequence[IdentifiedAxis], pieces: Sequence[tuple[int, int]]
) -> list[Jump]:
    """Return the jumps of all axes, each place once."""
    series = record.pseudo_open_loop([axis.sensor_gain for axis in axes])
    return merge_jumps(
        [jump for i, axis in enumerate(axes) for jump in find_jumps(series[:, i], axis, pieces)]
    )


def merge_jumps(found: Sequence[Jump]) -> list[Jump]:
    """Return jumps by rising frame, each place once."""
    out: list[Jump] = []
    for jump in sorted(found, key=lambda jump: jump.frame):
        if not out or jump.frame - out[-1].frame > _SAME_JUMP:
            out.append(jump)
    return out


def _cut_at_jumps(pieces: list[tuple[int, int]], broken: Sequence[Jump]) -> list[tuple[int, int]]:
    """Cut the stretches at jumps, if there are few."""
    return (
        cut_around(pieces, [jump.frame for jump in broken])
        if len(broken) <= _MOST_JUMPS
        else pieces
    )


def _describe_jumps(broken: Sequence[Jump], of: str) -> str:
    """Return what is said of jumps."""
    first = max(broken, key=lambda jump: jump.size)
    text = (
        f"warning: {len(broken)} jump{'s' if len(broken) > 1 else ''} of the {of}, the largest at "
        f"frame {first.frame} with {first.size:.0f} standard deviations"
    )
    if len(broken) <= _MOST_JUMPS:
        return f"{text}; the record was cut there"
    return f"{text}; too many to cut the record there, and the model suffers"


def _find_doubts(
    record: LoopRecord,
    axes: Sequence[IdentifiedAxis],
    told: Sequence[int],
    pieces: Sequence[tuple[int, int]],
) -> list[str]:
    """Return warnings of a delay that does not fit, and of noise that is not seen."""
    out = []
    if told and record.commands is not None:
        other = better_delay(record, told[0], axes[told[0]], pieces)
        if other is not None:
            out.append(
                f"warning: a delay of {other[0]:g} frames fits better than {record.delay_frames:g} "
                f"(its criterion is better by {other[1]:.0f}). Check the delay"
            )
    out += [
        f"warning: axis {i} has a sensor gain of {axes[i].sensor_gain:.3g}: are the units, signs "
        "and axes of the commands right?"
        for i in told
        if not _LEAST_GAIN < axes[i].sensor_gain < _MOST_GAIN
    ]
    out += [
        f"warning: the noise of axis {i} is not seen under the rest of its spectrum"
        for i, axis in enumerate(axes)
        if axis.noise_error_nm > _UNSEEN * axis.noise_nm
    ]
    return out


def _gain_per_axis(given: Any, count: int) -> list[float | None]:
    """One gain an axis, or None."""
    if given is None:
        return [None] * count
    try:
        values = np.atleast_1d(np.asarray(given, dtype=float))
    except (TypeError, ValueError) as error:
        raise ProblemError(f"sensor_gain must be numbers; got {given!r}.") from error
    if values.shape not in ((1,), (count,)):
        raise ProblemError(f"sensor_gain must be one number, or {count}; got {given!r}.")
    return [float(v) for v in np.broadcast_to(values, (count,))]


def _pool_gains(
    axes: list[IdentifiedAxis],
    told: list[int],
    one: Callable[[int, float | None, IdentifiedAxis | None, float], IdentifiedAxis],
) -> tuple[list[IdentifiedAxis], str]:
    """Fit the axes again with the mean of the gains, where there is one."""
    log = np.array([np.log(axes[i].sensor_gain) for i in told])
    error = np.array([axes[i].sensor_gain_error or 0.0 for i in told]) / np.exp(log)
    weight = 1 / error**2
    mean = float(np.sum(weight * log) / np.sum(weight))
    if np.any(np.abs(log - mean) > _APART * error):
        values = ", ".join(
            f"{np.exp(v):.3f} +- {np.exp(v) * e:.3f}" for v, e in zip(log, error, strict=True)
        )
        return axes, f"warning: the axes have different sensor gains, {values}"
    gain = float(np.exp(mean))
    spread = gain / float(np.sqrt(np.sum(weight)))
    out = [
        replace(
            one(i, gain, axis, spread),
            sensor_gain_note=(
                "mean of the axes"
                if len(told) == len(axes)
                else "found in the closed loop's data"
                if i in told
                else "that of the other axis"
            ),
        )
        for i, axis in enumerate(axes)
    ]
    return out, "one sensor gain for all axes"
