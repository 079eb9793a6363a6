"""The least residual of any linear controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import assert_never

import numpy as np

from lbt_synth.errors import CoupledModesError
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop.least_residuals.mode_spectra import ModeSpectrum, decoupled_modes, plant_modes
from lbt_synth.loop.least_residuals.prediction import Prediction
from lbt_synth.models import (
    FullStatePlant,
    LoopHardware,
    SinusoidalVibration,
    TipTiltPlant,
    Truth,
    Vibration,
)
from lbt_synth.models.vibration.in_a_loop import checked_direction, stationary_vibrations
from lbt_synth.validation import FloatArray, frozen_copy, require_instance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualLimit:
    """The least residual of any linear controller.

    Attributes
    ----------
    variance_nm2 : (n,) ndarray
        Least variance along each direction [nm^2].
    directions : (n, n) ndarray
        Directions over the modes, one per row, along which the loop decouples.
    change : float
        What the last refinement of the integrals changed, relative to the variance; the
        largest over the directions.
    """

    variance_nm2: FloatArray
    directions: FloatArray
    change: float

    @property
    def rms_nm(self) -> float:
        """Least residual over all modes [nm rms]."""
        return float(np.sqrt(np.sum(self.variance_nm2)))


def least_residual(hardware: LoopHardware, truth: Truth) -> ResidualLimit:
    """Least stationary residual that any linear controller leaves under a truth.

    By spectral factorisation, without any design: a controller that knew the spectra, the
    noise and the sensor gain could come as close to it as it likes, none could pass it.
    Sinusoids of the truth cost nothing (one frequency can be rejected entirely at a price as
    small as one likes) and are left out; see :func:`least_worst_residual` for one whose
    frequency is not known. Random vibrations count with their spectra.

    Parameters
    ----------
    hardware : LoopHardware
        The loop, with any delay. The sensor must see and the mirror reach every mode.
    truth : Truth
        Disturbances, noise and sensor gain.

    Returns
    -------
    ResidualLimit
        Least variance along each direction, and the least residual.

    Raises
    ------
    ProblemError
        If a mode is not seen or not reached, the modes do not decouple, or a disturbance does
        not fit the loop.
    NumericalError
        If an integral over a spectrum does not settle.

    Examples
    --------
    An AR1 process without noise, predicted over two frames:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=2.0, frame_rate_hz=800)
    >>> limit = lbt.loop.least_residual(path, lbt.Truth(turbulence=slow))
    >>> round(float(limit.variance_nm2[0]), 8)  # 2^2 (1 + 0.5^2)
    5.0
    """
    return _residual_limit(*truth_modes(hardware, truth))


def least_model_residual(plant: TipTiltPlant | FullStatePlant) -> ResidualLimit:
    """Least residual that any linear controller leaves where a plant's model is the truth.

    Coupled modes have a limit where nothing but whole frames of delay is between command and
    mirror: the error of the best estimate, from a Riccati equation.
    """
    if isinstance(plant, FullStatePlant):
        return _residual_limit(*plant_modes(plant))
    hardware = plant.hardware
    lines = [(checked_direction(line, hardware), line) for line in plant.vibrations]
    try:
        modes = decoupled_modes(hardware, plant.R, plant.turbulence, lines)
    except CoupledModesError:
        if hardware.mirror is not None or hardware.delay_frames % 1:
            raise
        error = plant.L @ kalman_riccati(plant).P @ plant.L.T
        variance, axes = np.linalg.eigh(error)
        return ResidualLimit(
            variance_nm2=frozen_copy(variance), directions=frozen_copy(axes.T), change=0.0
        )
    return _residual_limit(*modes)


def truth_modes(
    hardware: LoopHardware, truth: Truth, directions: tuple[FloatArray, ...] = ()
) -> tuple[FloatArray, list[ModeSpectrum]]:
    """Decouple the modes of a truth without its sinusoids, as :func:`decoupled_modes`."""
    require_instance(hardware, LoopHardware)
    require_instance(truth, Truth)
    lines = []
    for vibration in stationary_vibrations(truth.vibrations):
        along = checked_direction(vibration, hardware)
        if isinstance(vibration, Vibration):
            lines.append((along, vibration))
        elif not isinstance(vibration, SinusoidalVibration):
            assert_never(vibration)  # a random vibration of a new kind counts, too
    noise = np.diag((truth.noise_per_measurement(hardware.n_measurements) / truth.sensor_gain) ** 2)
    turbulence = truth.turbulence_per_mode(hardware.modes)
    return decoupled_modes(hardware, noise, turbulence, lines, directions)


def _residual_limit(directions: FloatArray, modes: list[ModeSpectrum]) -> ResidualLimit:
    known: dict[tuple[object, ...], tuple[float, float]] = {}
    found = []
    for mode in modes:
        key = (tuple(id(part) for part in mode.parts), mode.noise_nm2)
        if key not in known:
            known[key] = mode_limit(mode)
        found.append(known[key])
    variance, change = np.array(found).T
    return ResidualLimit(
        variance_nm2=frozen_copy(variance),
        directions=frozen_copy(directions),
        change=float(np.max(change)),
    )


def mode_limit(mode: ModeSpectrum) -> tuple[float, float]:
    """Least variance of one mode, and its relative change at the last refinement."""
    reference = mode.reference()
    panels = mode.log_moments(reference) if mode.parts and reference > 0 else None
    if panels is None:  # nothing to correct, or all of it can be predicted
        return 0.0, 0.0
    moments = panels.integrals.sum(axis=0)
    variance = Prediction.of(mode.inner, moments).variance(reference, mode.noise_nm2)
    scale = min(1.0, float(moments[0])) if mode.noise_nm2 > 0 else 1.0
    return variance, panels.change / scale if scale > 0 else 0.0
