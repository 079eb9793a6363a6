"""Strehl ratio of one design over frequency error, sensor gain and delay error, exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.loop import Imaging
from lbt_synth.loop.budget import ar_covariance, noise_covariance
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, close_loops, loop_poles
from lbt_synth.loop.sensor_gains import rejections, spectrum_covariances
from lbt_synth.loop.strehl import jitter_spread_nm, jitter_strehls, widest_jitter_nm
from lbt_synth.models import ARModel, LoopHardware, Truth, Vibration
from lbt_synth.models.truth import fitted_direction, stationary_vibrations
from lbt_synth.statespace import Controller
from lbt_synth.validation import (
    BoolArray,
    ComplexArray,
    FloatArray,
    frozen,
    instance,
    number,
    real_array,
)

_GAINS_AT_ONCE = 64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StrehlMap:
    """Strehl ratio of a fixed design over what it may have been told wrongly.

    Attributes
    ----------
    errors_hz : (e,) ndarray
        Frequency that the design believes less the true one [Hz].
    sensor_gains : (g,) ndarray
        Real sensor gain relative to the design's sensor matrix.
    delay_errors_frames : (d,) ndarray
        Real delay less that of the design [frames].
    strehl : (d, g, e) ndarray
        Strehl ratio in [0, 1]; nan where the loop is unstable, 0 where the image moves by more
        than 160 times its width.
    residual_nm : (d, g, e) ndarray
        Residual of the modes [nm rms]; nan where the loop is unstable.
    stable : (d, g) bool ndarray
        Whether the loop is stable. A frequency error has no part in that.
    """

    errors_hz: FloatArray
    sensor_gains: FloatArray
    delay_errors_frames: FloatArray
    strehl: FloatArray
    residual_nm: FloatArray
    stable: BoolArray


def strehl_map(
    design: Design,
    truth: Truth,
    imaging: Imaging,
    *,
    errors_hz: Any,
    sensor_gains: Any,
    delay_errors_frames: Any = (0.0,),
    advance: Callable[[int], object] | None = None,
) -> StrehlMap:
    """Evaluate one design exactly over frequency errors, sensor gains and delay errors.

    Parameters
    ----------
    design : Design
        The design, with a loop of one or two modes; its controller stays as it is.
    truth : Truth
        What the loop meets without any error. Its own sensor gain plays no part.
    imaging : Imaging
        The camera.
    errors_hz : (e,) array_like
        Frequency that the design believes less the true one [Hz]: every vibration of the truth
        is moved by minus the error, its rms kept.
    sensor_gains : (g,) array_like
        Real sensor gains relative to the design's sensor matrix.
    delay_errors_frames : (d,) array_like, optional
        Real delay less that of the design [frames].
    advance : callable, optional
        Called with a number of points whenever they are done.

    Returns
    -------
    StrehlMap
        Strehl ratio, residual and stability at all combinations.

    Raises
    ------
    ProblemError
        If the design has no loop, or a value is out of its range or given twice.
    DimensionError
        If the loop has more than two modes, or a vibration another number of them.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.005, rms_nm=797)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, vibrations=[line],
    ...                            noise_nm=15.5)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=15.5, vibrations=(
    ...     lbt.SinusoidalVibration(frequency_hz=20, rms_nm=797),))
    >>> found = lbt.strehl_map(lbt.kalman(plant), truth, lbt.Imaging(diameter_m=8.22),
    ...                        errors_hz=[0, 3], sensor_gains=[0.5, 1.0, 9.0])
    >>> found.strehl.shape, found.stable[0].tolist()
    ((1, 3, 2), [True, True, False])
    >>> bool(found.strehl[0, 1, 0] > found.strehl[0, 1, 1])
    True
    """
    for value, kind in ((design, Design), (truth, Truth), (imaging, Imaging)):
        instance(value, kind)
    hardware = design.hardware
    if hardware is None:
        raise ProblemError(
            "a map needs a design for a loop; got one of a bare estimation problem. Design for a "
            "plant of tip_tilt_plant."
        )
    if hardware.modes > 2:
        raise DimensionError(
            f"a Strehl ratio of jitter takes 1 or 2 axes; got a loop of {hardware.modes} modes."
        )
    errors = _axis(errors_hz, "errors_hz")
    gains = _axis(sensor_gains, "sensor_gains", above=0)
    delays = _axis(
        delay_errors_frames,
        "delay_errors_frames",
        at_least=1 - hardware.delay_frames,
        at_most=100 - hardware.delay_frames,
        hint=f"The design's delay of {hardware.delay_frames:g} frames and the error together must "
        "lie between 1 and 100.",
    )
    truths = [_moved(truth, error, hardware) for error in errors]
    shape = (delays.size, gains.size, errors.size)
    strehls, residuals = np.full(shape, np.nan), np.full(shape, np.nan)
    stable = np.zeros(shape[:2], dtype=np.bool_)
    for i, delay in enumerate(delays):
        real = replace(hardware, delay_frames=hardware.delay_frames + delay)
        for start in range(0, gains.size, _GAINS_AT_ONCE):
            rows = slice(start, start + _GAINS_AT_ONCE)
            poles = loop_poles(real, design.controller, gains[rows])
            inside = np.max(np.abs(poles), axis=1) < 1 - STABILITY_MARGIN
            stable[i, rows] = inside
            found = np.nonzero(inside)[0]
            if found.size:
                strehls[i, start + found], residuals[i, start + found] = _evaluated(
                    real, design.controller, gains[rows][found], poles[found], truths, imaging
                )
            if advance is not None:
                advance(len(inside) * errors.size)
    stable.setflags(write=False)
    return StrehlMap(
        errors_hz=errors,
        sensor_gains=gains,
        delay_errors_frames=delays,
        strehl=frozen(strehls),
        residual_nm=frozen(residuals),
        stable=stable,
    )


def _axis(values: Any, name: str, **bounds: Any) -> FloatArray:
    """Values of one axis of the map, each within its bounds and there once."""
    axis = real_array(values, name)
    if axis.ndim != 1 or axis.size == 0:
        raise DimensionError(f"{name} must be a list of at least one number; got {axis.shape}.")
    for value in axis:
        number(value, name, **bounds)
    if np.unique(axis).size != axis.size:
        raise ProblemError(f"{name} must hold each value once; got {axis.tolist()}.")
    return axis


def _moved(truth: Truth, error_hz: float, hardware: LoopHardware) -> Truth:
    """Truth whose vibrations lie below what the design believes by an error."""
    if not truth.vibrations and error_hz != 0:
        raise ProblemError(
            "a frequency error needs a vibration in the truth; got a truth without any."
        )
    nyquist = hardware.frame_rate_hz / 2
    moved = []
    for vibration in stationary_vibrations(truth.vibrations):
        fitted_direction(vibration, hardware)
        frequency = vibration.frequency_hz - float(error_hz)
        if not 0 < frequency < nyquist:
            raise ProblemError(
                f"errors_hz must leave each vibration between 0 and {nyquist:.6g} Hz; got an error "
                f"of {error_hz:.6g} Hz, which moves the one at {vibration.frequency_hz:.6g} Hz to "
                f"{frequency:.6g} Hz."
            )
        moved.append(replace(vibration, frequency_hz=frequency))
    return replace(truth, vibrations=tuple(moved))


def _evaluated(
    hardware: LoopHardware,
    controller: Controller,
    gains: FloatArray,
    poles: ComplexArray,
    truths: list[Truth],
    imaging: Imaging,
) -> tuple[FloatArray, FloatArray]:
    """Strehl ratio and residual [nm rms] at stable gains and all truths, (g, e) each."""
    n, shape = hardware.modes, (len(gains), len(truths))
    loops = close_loops(hardware, controller, gains)
    # the others are computed from the loop that is furthest from instability
    reference = loops[int(np.argmin(np.max(np.abs(poles), axis=1)))]
    truth = truths[0]  # turbulence and noise are the same in all of them
    common = np.array([noise_covariance(loop, truth) for loop in loops])
    for spectrum, modes in truth.turbulence_groups(n):
        if isinstance(spectrum, ARModel):
            common += [ar_covariance(loop, spectrum, np.eye(n)[list(modes)]) for loop in loops]
        else:
            common += spectrum_covariances(reference, gains, poles, spectrum, modes)

    gaussian = np.repeat(common[:, None], len(truths), axis=1)
    lines = []
    moved = (stationary_vibrations(truth.vibrations) for truth in truths)
    for same in zip(*moved, strict=True):  # one vibration, moved
        direction = fitted_direction(same[0], hardware)
        if isinstance(same[0], Vibration):
            models = [line.ar_model(hardware.frame_rate_hz) for line in same]
            gaussian += [[ar_covariance(lo, m, direction[None]) for m in models] for lo in loops]
        else:
            frequencies = np.array([line.frequency_hz for line in same])
            response = rejections(reference, gains, frequencies) @ direction
            lines.append(same[0].amplitude_nm * np.swapaxes(response, 0, 1))
    amplitudes = np.stack(lines, axis=2) if lines else np.zeros((*shape, 0, n), np.complex128)

    power = np.trace(gaussian, axis1=2, axis2=3) + np.sum(np.abs(amplitudes) ** 2, axis=(2, 3)) / 2
    covariances, amplitudes = gaussian.reshape(-1, n, n), amplitudes.reshape(power.size, -1, n)
    seen = jitter_spread_nm(covariances, amplitudes) <= widest_jitter_nm(imaging)
    strehls = np.zeros(power.size)
    strehls[seen] = jitter_strehls(
        covariances[seen], imaging=imaging, line_amplitudes_nm=amplitudes[seen]
    )
    return strehls.reshape(shape), np.sqrt(power)
