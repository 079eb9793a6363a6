"""Both axes of a loop, with one sensor gain where the data agree on one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.identify import (
    LOWEST_LINE_HZ,
    MOST_LINES,
    identify_axis,
)
from lbt_synth.identification.result import IdentifiedAxis, IdentifiedModel

if TYPE_CHECKING:
    from lbt_synth.records import LinePrior, LoopRecord

_APART = 3.0  # standard errors between gains that are not the same


def identify(
    record: LoopRecord,
    *,
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
    record : LoopRecord
        What the loop recorded, in closed or open loop; the delay must be known in closed loop.
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
    >>> slow = lbt.ARModel(coefficients=[0.99], driving_rms_nm=2.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> loop = lbt.integrator(path, gain=0.4)
    >>> run = lbt.simulate(loop.controller, truth, hardware=path, frames=20_000)
    >>> record = lbt.loop_record(run.measurements[0], run.commands[0], frame_rate_hz=500,
    ...                          delay_frames=2, unit="nm")
    >>> found = lbt.identify(record)
    >>> [[round(line.frequency_hz) for line in axis.lines] for axis in found.axes]
    [[40], []]
    >>> lbt.kalman(found.plant()).certificate.passed
    True
    """
    count = record.measurements.shape[1]
    gains = _gains(sensor_gain, count)
    corrections = None
    delay = record.delay_frames
    if record.commands is not None:
        if delay is None:
            raise ProblemError(
                "the delay of a closed loop is needed to know what the mirror did; got a record "
                "without one. Give delay_frames."
            )
        corrections = record.corrections()
    pieces = record.stretches() if stretches is None else stretches
    known = [(line.frequency_hz, line.frequency_error_hz) for line in announced]
    total, done = 2 * count, 0

    def one(i: int, gain: float | None, begin: IdentifiedAxis | None) -> IdentifiedAxis:
        nonlocal done
        found = identify_axis(
            record.measurements[:, i],
            None if corrections is None else corrections[:, i],
            frame_rate_hz=record.frame_rate_hz,
            stretches=pieces,
            sensor_gain=gain,
            assumed_gain=assumed_gain,
            announced=known,
            lowest_line_hz=lowest_line_hz,
            most_lines=most_lines,
            start=begin,
        )
        done += 1
        if progress is not None:
            progress(done, total)
        return found

    axes = [one(i, gains[i], None if start is None else start.axes[i]) for i in range(count)]
    notes: list[str] = []
    told = [i for i in range(count) if axes[i].sensor_gain_error is not None]
    if count > 1 and told and all(gain is None for gain in gains):
        axes, note = _pooled(axes, told, one)
        notes.append(note)
    if progress is not None and done < total:
        progress(total, total)
    return IdentifiedModel(
        axes=tuple(axes),
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=2.0 if delay is None else delay,
        mirror=record.mirror,
        notes=tuple(notes),
    )


def _gains(given: Any, count: int) -> list[float | None]:
    """One gain an axis, or None."""
    if given is None:
        return [None] * count
    values = np.atleast_1d(np.asarray(given, dtype=float))
    if values.shape not in ((1,), (count,)):
        raise ProblemError(f"sensor_gain must be one number, or {count}; got {given!r}.")
    return [float(v) for v in np.broadcast_to(values, (count,))]


def _pooled(
    axes: list[IdentifiedAxis],
    told: list[int],
    one: Callable[[int, float | None, IdentifiedAxis | None], IdentifiedAxis],
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
        return axes, f"the axes have different sensor gains: {values}"
    gain = float(np.exp(mean))
    spread = gain / float(np.sqrt(np.sum(weight)))
    out = [
        replace(
            one(i, gain, axis),
            sensor_gain_error=spread,
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
