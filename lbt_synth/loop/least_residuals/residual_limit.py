"""The least residual of any linear controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import CoupledModesError, LbtSynthError, ProblemError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.least_residuals.mode_spectra import (
    InnerFactor,
    ModeSpectrum,
    Prediction,
    decoupled_modes,
)
from lbt_synth.models import (
    LoopHardware,
    TipTiltPlant,
    Truth,
    Vibration,
)
from lbt_synth.models.plant.assembly import other_exposures
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualLimit:
    """The least residual of any linear controller."""

    variance_nm2: FloatArray  # (n,): least variance along each direction [nm^2]
    within_nm2: FloatArray  # (n,): the part of it that moves within frames [nm^2]
    # (n, n): directions over the modes, one per row, along which the loop decouples
    directions: FloatArray
    # what the last refinement of the integrals changed, relative to the variance; the largest over
    # the directions
    change: float

    @property
    def rms_nm(self) -> float:
        """Least residual over all modes [nm rms]."""
        return float(np.sqrt(np.sum(self.variance_nm2)))


def least_residual(
    hardware: LoopHardware, truth: Truth, *, frame_means: bool = False
) -> ResidualLimit:
    """Least stationary residual that any linear controller leaves under a truth, in the image.

    By spectral factorisation, without any design: a controller that knew the spectra, the
    noise and the sensor gain could come as close to it as it likes, none could pass it.
    Of sinusoids there remains what moves within a frame, since no command follows it: one frequency
    can be rejected entirely at a price as small as one likes; see :func:`least_worst_residual` for
    one whose frequency is not known. Random vibrations count with their spectra.

    With other sensors beside the loop's own it is the least residual of a loop that knows more:
    each wavefront sensor reads each frame of its exposures at once, with as much noise as gives the
    mean its own; accelerometers know all vibrations in advance. A sensor that reads each frame at
    the loop's own delay loses nothing by that, a slow or late one a little.

    Parameters
    ----------
    hardware : LoopHardware
        The loop, with any delay. The sensor must see and the mirror reach every mode.
    truth : Truth
        Disturbances, noise and sensor gain.
    frame_means : bool, optional
        As in :func:`residual_budget`.

    Returns
    -------
    ResidualLimit
        Least variance along each direction, and the least residual.

    Raises
    ------
    ProblemError
        If a mode is not seen or not reached, the modes do not decouple, or a disturbance does
        not fit the loop; also where an exposure of another sensor ends within a frame, or in
        the image of a mirror with dynamics.
    NumericalError
        If an integral over a spectrum does not settle.

    Examples
    --------
    An AR1 process without noise, predicted over two frames:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=2.0, frame_rate_hz=800)
    >>> limit = lbt.loop.least_residual(path, lbt.Truth(turbulence=slow), frame_means=True)
    >>> round(float(limit.variance_nm2[0]), 8)  # 2^2 (1 + 0.5^2)
    5.0
    """
    require_instance(hardware, LoopHardware)
    if hardware.suite.sensors:
        return _limit_of_sensors(hardware, truth, in_image=not frame_means)
    return _residual_limit(*truth_modes(hardware, truth, in_image=not frame_means))


def _limit_of_sensors(hardware: LoopHardware, truth: Truth, *, in_image: bool) -> ResidualLimit:
    """Return the limit of the loop that knows more than that of several sensors."""
    suite = hardware.suite
    if suite.accelerometers:
        truth = replace(truth, vibrations=(), motions=(), frequency_errors_hz=None)
    noise = truth.noise_per_measurement(hardware.n_measurements) / truth.sensor_gain
    sensor, blocks = [hardware.sensor], [np.diag(noise**2)]
    for other, seen in zip(suite.wavefront, other_exposures(hardware), strict=True):
        if seen.age_frames % 1:
            raise ProblemError(
                f"no limit is known where an exposure of sensor {other.name} ends within a frame "
                f"of the loop; it ends {seen.age_frames % 1:.3g} frames after one begins."
            )
        factor = other.noise_factor(hardware.modes)
        sensor.append(seen.response)
        blocks.append(seen.period * factor @ factor.T)
    if not noise.any():  # nothing adds to a sensor without noise
        sensor, blocks = sensor[:1], blocks[:1]
    every = replace(hardware.own_sensor_alone(), sensor_matrix=np.vstack(sensor))
    modes = truth_modes(every, truth, noise_nm2=block_diag(*blocks), in_image=in_image)
    return _residual_limit(*modes)


def least_model_residual(plant: TipTiltPlant, *, frame_means: bool = False) -> ResidualLimit:
    """Least residual that any linear controller leaves where a plant's model is the truth.

    It is that in the image, or of means over frames; the processes of a plant are of such means.
    Coupled modes have a limit where nothing but whole frames of delay is between command and
    mirror: the error of the best estimate, from a Riccati equation, and what moves within frames.
    """
    hardware, rate, in_image = plant.hardware, plant.hardware.frame_rate_hz, not frame_means
    inner = InnerFactor.of(hardware, in_image=in_image)
    lines = [(checked_direction(line, hardware), line) for line in plant.vibrations]
    try:
        modes = decoupled_modes(hardware, plant.R, plant.turbulence, lines, in_image=in_image)
    except CoupledModesError:
        if hardware.mirror is not None or hardware.delay_frames % 1:
            raise
        parts = list(zip(np.eye(hardware.modes), plant.turbulence, strict=True))
        parts += [(along, line.ar_model(rate)) for along, line in lines]
        within = np.zeros((hardware.modes, hardware.modes))
        for along, model in parts:
            mode = ModeSpectrum(inner, rate, (model,), 0.0, in_image)
            within += mode.within_frames_nm2() * np.outer(along, along)
        error = plant.L @ kalman_riccati(plant).P @ plant.L.T
        variance, axes = np.linalg.eigh(error + within)
        return ResidualLimit(
            variance_nm2=frozen_copy(variance),
            within_nm2=frozen_copy(np.einsum("in,ij,jn->n", axes, within, axes)),
            directions=frozen_copy(axes.T),
            change=0.0,
        )
    return _residual_limit(*modes)


def truth_modes(
    hardware: LoopHardware,
    truth: Truth,
    directions: tuple[FloatArray, ...] = (),
    *,
    in_image: bool,
    noise_nm2: FloatArray | None = None,
) -> tuple[FloatArray, list[ModeSpectrum]]:
    """Decouple the modes of a truth; noise (q, q) is that of the own sensor by default."""
    require_instance(hardware, LoopHardware)
    require_instance(truth, Truth)
    lines, sinusoids = [], []
    for vibration in stationary_vibrations(truth.vibrations):
        along = checked_direction(vibration, hardware)
        if isinstance(vibration, Vibration):
            if in_image:  # frames have its mean
                share = float(np.sinc(vibration.frequency_hz / hardware.frame_rate_hz))
                vibration = replace(vibration, rms_nm=share * vibration.rms_nm)
            lines.append((along, vibration))
        else:
            sinusoids.append((along, vibration))
    if noise_nm2 is None:
        noise = truth.noise_per_measurement(hardware.n_measurements) / truth.sensor_gain
        noise_nm2 = np.diag(noise**2)
    turbulence = truth.turbulence_per_mode(hardware.modes)
    return decoupled_modes(
        hardware,
        noise_nm2,
        turbulence,
        lines,
        directions,
        in_image=in_image,
        sinusoids=sinusoids,
    )


def _residual_limit(directions: FloatArray, modes: list[ModeSpectrum]) -> ResidualLimit:
    known: dict[tuple[object, ...], tuple[float, float, float]] = {}
    limits = []
    for mode in modes:
        key = (tuple(id(part) for part in mode.parts), mode.noise_nm2, mode.sinusoids)
        if key not in known:
            known[key] = (*mode_limit(mode), mode.within_frames_nm2())
        limits.append(known[key])
    variance, change, within = np.array(limits).T
    return ResidualLimit(
        variance_nm2=frozen_copy(variance + within),
        within_nm2=frozen_copy(within),
        directions=frozen_copy(directions),
        change=float(np.max(change)),
    )


def mode_limit(mode: ModeSpectrum) -> tuple[float, float]:
    """Least variance of the means of one mode, and its relative change at the last refinement."""
    reference = mode.reference()
    panels = mode.log_moments(reference) if mode.parts and reference > 0 else None
    if panels is None:  # nothing to correct, or all of it can be predicted
        return 0.0, 0.0
    moments = panels.integrals.sum(axis=0)
    variance = Prediction.of(mode.inner, moments).variance(reference, mode.noise_nm2)
    scale = min(1.0, float(moments[0])) if mode.noise_nm2 > 0 else 1.0
    return variance, panels.change / scale if scale > 0 else 0.0


def above_percent(rms_nm: float, limit_nm: float) -> float:
    """Return how far a residual is above a limit [%]; nan where the limit is 0 or nan."""
    return 100 * (rms_nm / limit_nm - 1) if limit_nm > 0 else np.nan


def limit_or_nan(limit: Callable[[], Any]) -> float:
    """Return the least residual [nm rms], nan where it cannot be computed."""
    found = limit_or_none(limit)
    return np.nan if found is None else float(found.rms_nm)


def limit_or_none(limit: Callable[[], T]) -> T | None:
    """Return the limit, None where it cannot be computed."""
    try:
        return limit()
    except LbtSynthError:
        return None
