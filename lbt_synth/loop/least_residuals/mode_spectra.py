"""Decoupled modes: the directions along which a loop splits, with their spectra and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lbt_synth.errors import CoupledModesError, ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import RefinedPanels, refine_panels
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.loop.least_residuals.prediction import InnerFactor
from lbt_synth.models import ARModel, FullStatePlant, LoopHardware, Spectrum, Vibration
from lbt_synth.models.spectra import breakpoints_below, spectrum_density, spectrum_key
from lbt_synth.validation import FloatArray, real_array

_COUPLING = 1e-9  # relative size above which an off-diagonal entry counts as coupling
_SAMPLES = 24  # frequencies at which the modes of a plant have to decouple


@dataclass(frozen=True, slots=True, eq=False)
class ModeSpectrum:
    """One decoupled mode: its disturbance and the white noise on its measurement."""

    inner: InnerFactor  # of the path to the residual
    rate_hz: float
    parts: tuple[Spectrum, ...]  # independent parts of the disturbance
    noise_nm2: float  # variance of the noise per frame, as a phase [nm^2]

    def power(self, x: FloatArray) -> FloatArray:
        """Two-sided disturbance spectrum per sample [nm^2] at x, in units of Nyquist."""
        nyquist = self.rate_hz / 2
        total = np.zeros(x.shape)
        for part in self.parts:
            total = total + spectrum_density(part, x * nyquist) * nyquist
        return total

    def edges(self, extra: Sequence[float] = ()) -> FloatArray:
        """First panels of (0, 1): geometric, and more of them at lines and kinks."""
        grid = [np.geomspace(1e-6, 1, 40), np.linspace(0, 1, 17), np.array(extra, dtype=float)]
        offsets = np.array([0.0, 1.0, 4.0, 16.0])
        for part in self.parts:
            grid.append(breakpoints_below(part, self.rate_hz / 2) / (self.rate_hz / 2))
            if isinstance(part, ARModel):
                for pole in np.linalg.eigvals(part.companion):
                    centre, width = abs(np.angle(pole)) / np.pi, (1 - abs(pole)) / np.pi
                    grid += [centre + offsets * width, centre - offsets * width]
        points = np.unique(np.clip(np.concatenate(grid), 0, 1))
        keep = np.concatenate([[True], np.diff(points) > 1e-12])
        return np.unique(np.concatenate([points[keep], [1.0], np.array(extra, dtype=float)]))

    def reference(self) -> float:
        """Return the unit of the logarithm [nm^2]: the noise, else the largest of the spectrum."""
        if self.noise_nm2 > 0:
            return self.noise_nm2
        edges = self.edges()
        return float(np.max(self.power((edges[1:] + edges[:-1]) / 2), initial=0.0))

    def log_moments(
        self, reference: float, *, ends: Sequence[float] = (), skip: bool = False
    ) -> RefinedPanels | None:
        """Integrals of ``log(Phi / reference)`` times the weights; None where Phi vanishes.

        The two ``ends`` are edges of panels; with ``skip``, the integrand between them is 0.
        """
        noiseless = self.noise_nm2 == 0

        def integrand(x: FloatArray) -> FloatArray:
            with np.errstate(over="ignore"):
                ratio = self.power(x) / reference
            if not np.all(np.isfinite(ratio)):
                raise ProblemError(
                    f"the noise variance {self.noise_nm2:.3g} nm^2 is too small beside the "
                    "disturbance to differ from zero; set noise_nm to 0."
                )
            if skip:
                ratio = np.where((x > ends[0]) & (x < ends[1]), 1.0, ratio)
            if noiseless and np.any(ratio == 0):
                raise _VanishingError
            values = np.log(ratio) if noiseless else np.log1p(ratio)
            return np.asarray(values[:, None] * self.inner.weights(x))

        try:
            return refine_panels(integrand, self.edges(ends), floor=1e-14 if noiseless else 0.0)
        except _VanishingError:
            return None


class _VanishingError(Exception):
    """A spectrum without noise is zero over an interval: the process can be predicted exactly."""


@dataclass(frozen=True, slots=True, eq=False)
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


def decoupled_modes(
    hardware: LoopHardware,
    noise_nm2: FloatArray,
    turbulence: Sequence[Spectrum | None],
    vibrations: Sequence[tuple[FloatArray, Vibration]],
    directions: Sequence[FloatArray] = (),
) -> tuple[FloatArray, list[ModeSpectrum]]:
    """Rotate the modes until disturbance and noise (q, q) are diagonal.

    Return the directions over the modes (rows) and the spectrum along each. Vibrations come with
    their directions (n,); further ``directions`` must be axes, too.
    """
    n, rate = hardware.modes, hardware.frame_rate_hz
    noise = _noise_on_modes(hardware, noise_nm2)
    rank = np.linalg.matrix_rank(hardware.influence)
    if rank < n:
        raise ProblemError(
            "the mirror must reach every mode: an influence matrix with full row rank; got rank "
            f"{rank} for {n} modes. Leave out the modes that it cannot correct."
        )
    for model in turbulence:
        if isinstance(model, ARModel):
            require_loop_rate(model.frame_rate_hz, hardware)
    # modes with the same spectrum may be turned into each other
    keys = [spectrum_key(spectrum) for spectrum in turbulence]
    kinds = dict(zip(keys, turbulence, strict=True))
    groups = {key: np.diag([float(own == key) for own in keys]) for key in kinds}
    matrices = [("the noise of the sensor", noise)]
    matrices += [("the turbulence", projector) for projector in groups.values()]
    for along, line in vibrations:
        matrices.append((f"the vibration at {line.frequency_hz:.6g} Hz", np.outer(along, along)))
    matrices += [("the given direction", np.outer(along, along)) for along in directions]
    axes = _common_axes(matrices)
    parts = []
    for axis in axes:
        own = next(key for key, projector in groups.items() if axis @ projector @ axis > 0.5)
        lines = [line.ar_model(rate) for along, line in vibrations if abs(along @ axis) > 0.5]
        parts.append(tuple(part for part in (kinds[own], *lines) if part is not None))
    return axes, _spectra_along(axes, parts, noise, hardware)


def _spectra_along(
    axes: FloatArray, parts: list[tuple[Spectrum, ...]], noise: FloatArray, hardware: LoopHardware
) -> list[ModeSpectrum]:
    inner, rate = InnerFactor.of(hardware), hardware.frame_rate_hz
    return [
        ModeSpectrum(inner, rate, own, max(float(axis @ noise @ axis), 0.0))
        for axis, own in zip(axes, parts, strict=True)
    ]


def _noise_on_modes(hardware: LoopHardware, noise_nm2: FloatArray) -> FloatArray:
    """Covariance (n, n) of the best unbiased estimate of the modes from one measurement."""
    sensor, n = hardware.sensor, hardware.modes
    rank = np.linalg.matrix_rank(sensor)
    if rank < n:
        raise ProblemError(
            "the sensor must see every mode: a sensor matrix with full column rank; got rank "
            f"{rank} for {n} modes. Leave out the modes that it does not see."
        )
    if not np.any(noise_nm2):
        return np.zeros((n, n))
    try:
        size = float(np.max(np.abs(noise_nm2)))
        factor = np.linalg.cholesky(noise_nm2 / size)
    except np.linalg.LinAlgError as error:
        raise ProblemError(
            "the noise must be zero, or have a positive definite covariance; got a singular one. "
            "Add a little noise to each measurement."
        ) from error
    white = np.linalg.solve(factor, sensor)
    return np.asarray(size * np.linalg.inv(white.T @ white))


def _common_axes(matrices: Sequence[tuple[str, FloatArray]]) -> FloatArray:
    """Orthonormal rows that make all symmetric matrices diagonal."""
    n = len(matrices[0][1])
    unit = [(name, m / max(float(np.linalg.norm(m, 2)), 1e-300)) for name, m in matrices]

    def coupled(axes: FloatArray) -> str | None:
        for name, m in unit:
            turned = axes @ m @ axes.T
            if np.max(np.abs(turned - np.diag(np.diag(turned)))) > _COUPLING:
                return name
        return None

    plain = np.eye(n)
    if coupled(plain) is None:
        return plain
    # matrices that commute share the eigenvectors of almost every sum of them
    shares = np.random.default_rng(0).uniform(1, 2, len(unit))
    axes = np.linalg.eigh(sum(s * m for s, (_, m) in zip(shares, unit, strict=True)))[1].T
    largest = np.argmax(np.abs(axes), axis=1)
    axes = axes * np.sign(axes[np.arange(n), largest])[:, None]
    axes = axes[np.argsort(largest, kind="stable")]
    name = coupled(axes)
    if name is not None:
        raise CoupledModesError(
            "a limit needs modes that decouple: vibrations parallel or at right angles to each "
            "other, along principal axes of the sensor's noise and within modes of one turbulence; "
            f"got {name} across them. Turn the directions, take equal noise on all modes, or treat "
            "each mode by itself."
        )
    return np.asarray(axes)


def plant_modes(plant: FullStatePlant) -> tuple[FloatArray, list[ModeSpectrum]]:
    """Decouple the modes of a plant that is given by its matrices, as :func:`decoupled_modes`."""
    hardware = plant.hardware
    noise = _noise_on_modes(hardware, plant.R)
    if np.any(plant.S):
        raise ProblemError(
            "a limit needs measurement noise that is independent of the disturbance; got a plant "
            "with B D' different from zero."
        )
    # the commands are left out: this is the response to the disturbance alone
    C = np.linalg.pinv(hardware.sensor) @ plant.C
    D = np.zeros((len(C), plant.B.shape[1]))
    system = StateSpace(A=plant.A, B=plant.B, C=C, D=D, dt_s=plant.dt_s)
    nyquist = hardware.frame_rate_hz / 2
    poles = ResponseSpectrum(system, np.ones(hardware.modes)).breakpoints_hz
    at = np.concatenate([np.geomspace(1e-5, 0.999, _SAMPLES) * nyquist, poles])
    response = system.frequency_response(at[(at > 0) & (at < nyquist)])
    spectra = response @ response.conj().transpose(0, 2, 1)
    matrices = [("the noise of the sensor", noise)]
    matrices += [("the disturbance", np.real(one)) for one in spectra]
    axes = _common_axes(matrices)
    turned = axes @ spectra @ axes.T
    crossed = np.abs(turned * (1 - np.eye(hardware.modes)))
    if np.any(crossed.max(axis=(1, 2)) > 1e-6 * np.abs(turned).max(axis=(1, 2))):
        raise ProblemError(
            "a limit needs modes that decouple; got disturbances of two modes that follow each "
            "other with a delay. Treat each mode by itself."
        )
    parts: list[tuple[Spectrum, ...]] = [(ResponseSpectrum(system, axis),) for axis in axes]
    return axes, _spectra_along(axes, parts, noise, hardware)
