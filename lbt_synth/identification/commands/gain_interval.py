"""The sensor gains that a record allows, and the designs that are stable at all of them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.identification.commands.control_law import record_control_law
from lbt_synth.identification.commands.doubts import gain_dilution
from lbt_synth.identification.commands.guesses import CoarseRecord, Guess
from lbt_synth.identification.commands.plausibility import could_have_run
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.loop import close_loop, stable_sensor_gains
from lbt_synth.validation import BoolArray, FloatArray

POSSIBLE_GAINS = _LEAST, _MOST = 0.08, 2.5  # of a sensor
_FAR_STEPS = 16
_NEAR = np.geomspace(0.7, 1.43, 21)  # of the best gain, itself included
_FAR = 6.0  # nats below the best gain that a record still allows


def allowed_gains(record: LoopRecord, model: IdentifiedModel | None = None) -> FloatArray:
    """Return the interval of sensor gains of each axis that a closed-loop record allows.

    Parameters
    ----------
    record : LoopRecord
        A closed-loop record with its delay.
    model : IdentifiedModel, optional
        Its resonances are part of the coarse spectrum, which has no wide ones of its own above
        25 Hz and would explain such by a wrong gain.

    Returns
    -------
    (axes, 2) ndarray
        Least and largest gain whose profile likelihood, by a coarse model of the spectrum, is
        within 6 of the best, more where the model misfits, and at which the recorded law is
        stable; 0.08 to 2.5 at most.

    Raises
    ------
    ProblemError
        If the record has no delay.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=20.0, frame_rate_hz=500)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=5.0, sensor_gain=0.6)
    >>> path = lbt.LoopHardware(frame_rate_hz=500, modes=1)
    >>> run = lbt.simulate(
    ...     lbt.integrator(path, gain=0.4).controller, truth, hardware=path, frames=10_000
    ... )
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> low, high = lbt.identification.allowed_gains(record)[0]
    >>> bool(low < 0.6 < high < 2)
    True
    """
    everything = np.tile([_LEAST, _MOST], (record.axes, 1))
    coarse = CoarseRecord(record, None if model is None else _resonances(model))
    if not coarse.stretches:
        return everything
    given = Guess(kind="as given")
    best = coarse.compare([given])
    far = np.geomspace(_LEAST, _MOST, _FAR_STEPS)
    grid = np.array([[*far, *(gain * _NEAR)] for gain in best.gain[:, 0]])
    excess = coarse.profile(given, grid) - best.axis_contrast
    allowed = excess < _FAR * best.dispersion(0)
    allowed[np.arange(len(grid)), np.argmin(excess, axis=1)] = True
    ends = [(np.min(row[good]), np.max(row[good])) for row, good in zip(grid, allowed, strict=True)]
    low, high = np.array(ends, dtype=np.float64).T
    high = high * gain_dilution(coarse) ** 2  # in steps, a gain looks smaller
    intervals: FloatArray = np.clip(np.column_stack([low, high]), _LEAST, _MOST)
    running = far[_has_run(record, far)]
    if not running.size:
        return intervals
    inside = np.clip(intervals, running[0], running[-1])
    apart = (intervals[:, 0] > running[-1]) | (intervals[:, 1] <= running[0])
    return np.where(apart[:, None], [running[0], running[-1]], inside)


def _resonances(model: IdentifiedModel) -> list[list[tuple[float, float]]]:
    """Return frequency [Hz] and damping ratio of the components of each axis."""
    to_hz = model.frame_rate_hz / (2 * np.pi)
    each = (axis.fitted_model.spectrum.components for axis in model.axes)
    return [[(c.frequency * to_hz, c.damping_ratio) for c in components] for components in each]


def _has_run(record: LoopRecord, gains: FloatArray) -> BoolArray:
    """Return at which gains (n,) the recorded law is stable; at all where there is no law."""
    try:
        law = record_control_law(record)
    except ProblemError:
        return np.ones(gains.size, dtype=np.bool_)
    if law.kind == "none" or law.lag_frames < 0:
        return np.ones(gains.size, dtype=np.bool_)
    given, one = Guess(kind="as given"), np.ones((1, record.axes))
    return np.array([could_have_run(given, gain * one, record, law) for gain in gains])


def unstable_gains(design: Design, gains: FloatArray) -> FloatArray | None:
    """Return sensor gains within intervals (axes, 2) at which a design's loop is unstable.

    Each corner of the box is tried, and all common factors on the design's own gains that its
    sides allow: exact for axes that decouple. None if the loop is stable at all of them.
    """
    hardware = design.hardware
    assert hardware is not None
    for corner in product(*gains):
        path = replace(hardware, sensor_matrix=np.diag(corner))
        if not close_loop(path, design.controller).is_stable:
            return np.array(corner)
    own = np.diag(hardware.sensor)
    factors = gains / own[:, None]
    low, high = stable_sensor_gains(hardware, design.controller)
    for factor in (np.min(factors), np.max(factors)):
        if not low < factor < high:
            return np.asarray(factor * own)
    return None
