"""Decoupled modes of a plant that is given by its matrices alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.loop.least_residuals.mode_spectra import (
    DecoupledModes,
    ModeSpectrum,
    common_axes,
    noise_on_modes,
)
from lbt_synth.models import FullStatePlant
from lbt_synth.validation import FloatArray, real_array

_SAMPLES = 24  # frequencies at which the modes have to decouple


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResponseSpectrum:
    """One-sided spectrum of one direction of a system driven by white noise."""

    system: StateSpace  # from unit white noise to the modes
    axis: FloatArray  # (n,)

    @property
    def breakpoints_hz(self) -> FloatArray:
        """Frequencies around the poles [Hz]."""
        poles = self.system.poles
        centre = np.abs(np.angle(poles)) / np.pi
        width = np.maximum(1 - np.abs(poles), 1e-9) / np.pi
        spread = centre[:, None] + width[:, None] * np.array([-16, -4, -1, 0, 1, 4, 16])
        return np.asarray(spread.ravel() / (2 * self.system.dt_s))

    def psd(self, frequency_hz: Any) -> FloatArray:
        """Return the spectrum [nm^2/Hz]."""
        frequency = real_array(frequency_hz, "frequency_hz")
        response = (self.axis[None] @ self.system.frequency_response(frequency.ravel()))[:, 0]
        power = np.sum(np.abs(response) ** 2, axis=-1)
        return np.asarray(2 * self.system.dt_s * power.reshape(frequency.shape))


def plant_modes(plant: FullStatePlant) -> DecoupledModes:
    """Decouple the modes of a plant with its commands as states."""
    hardware = plant.hardware
    noise = noise_on_modes(hardware, plant.R)
    if np.any(plant.S):
        raise ProblemError(
            "a limit needs measurement noise that is independent of the disturbance; got a plant "
            "with B D' different from zero."
        )
    # the commands are left out: this is the response to the disturbance alone
    see = np.linalg.pinv(hardware.sensor)
    system = StateSpace(
        A=plant.A, B=plant.B, C=see @ plant.C, D=np.zeros_like(see @ plant.D), dt_s=plant.dt_s
    )
    nyquist = hardware.frame_rate_hz / 2
    poles = ResponseSpectrum(system=system, axis=np.ones(hardware.modes)).breakpoints_hz
    at = np.concatenate([np.geomspace(1e-5, 0.999, _SAMPLES) * nyquist, poles])
    response = system.frequency_response(at[(at > 0) & (at < nyquist)])
    spectra = response @ response.conj().transpose(0, 2, 1)
    matrices = [("the noise of the sensor", noise)]
    matrices += [("the disturbance", np.real(one)) for one in spectra]
    axes = common_axes(matrices)
    turned = axes @ spectra @ axes.T
    crossed = np.abs(turned * (1 - np.eye(hardware.modes)))
    if np.any(crossed.max(axis=(1, 2)) > 1e-6 * np.abs(turned).max(axis=(1, 2))):
        raise ProblemError(
            "a limit needs modes that decouple; got disturbances of two modes that follow each "
            "other with a delay. Treat each mode by itself."
        )
    modes = tuple(
        ModeSpectrum(
            rate_hz=hardware.frame_rate_hz,
            parts=(ResponseSpectrum(system=system, axis=axis),),
            noise_nm2=max(float(axis @ noise @ axis), 0.0),
        )
        for axis in axes
    )
    return DecoupledModes(directions=axes, modes=modes)
