"""Decoupled modes: the directions along which a loop splits, with their spectra and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.errors import CoupledModesError, ProblemError
from lbt_synth.linear.quadrature import RefinedPanels, refine_panels
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.loop.least_residuals.prediction import InnerFactor, Interpolation
from lbt_synth.models import ARModel, LoopHardware, SinusoidalVibration, Spectrum, Vibration
from lbt_synth.models.spectra import breakpoints_below, spectrum_density, spectrum_key
from lbt_synth.validation import FloatArray

_COUPLING = 1e-9  # relative size above which an off-diagonal entry counts as coupling


@dataclass(frozen=True, slots=True, eq=False)
class ModeSpectrum:
    """One decoupled mode: its disturbance and the white noise on its measurement."""

    inner: InnerFactor  # of the path to the residual
    rate_hz: float
    parts: tuple[Spectrum, ...]  # independent parts of the disturbance
    noise_nm2: float  # variance of the noise per frame, as a phase [nm^2]
    in_image: bool  # whether spectra are of all moments, of which frames have the means
    sinusoids: tuple[tuple[float, float], ...] = ()  # frequency [Hz] and rms [nm] of each

    def power(self, x: FloatArray) -> FloatArray:
        """Two-sided disturbance spectrum per sample [nm^2] at x, in units of Nyquist."""
        nyquist = self.rate_hz / 2
        total = np.zeros(x.shape)
        for part in self.parts:
            density = spectrum_density(part, x * nyquist) * nyquist
            if self.in_image and not isinstance(part, ARModel):
                density = density * np.sinc(x / 2) ** 2
            total = total + density
        return total

    def interpolated(self, delay_frames: float) -> ModeSpectrum:
        """Return the mode of which the mean over a hold between two frames is to be predicted."""
        lags = Interpolation.lags(delay_frames)

        def covariances(x: FloatArray) -> FloatArray:
            return np.asarray(self.power(x)[:, None] * np.cos(np.pi * x[:, None] * lags))

        moments = np.zeros(lags.size)
        if self.parts:
            moments = refine_panels(covariances, self.edges()).integrals.sum(axis=0)
        target = Interpolation.of(delay_frames, moments)
        return replace(self, inner=replace(self.inner, target=target))

    def within_frames_nm2(self) -> float:
        """Power that moves within frames, which no command follows [nm^2]."""
        if not self.in_image:
            return 0.0

        def moving(x: FloatArray) -> FloatArray:
            return np.asarray(self.power(x)[:, None] * (1 / np.sinc(x / 2) ** 2 - 1)[:, None])

        shares = [rms**2 * (1 - np.sinc(f / self.rate_hz) ** 2) for f, rms in self.sinusoids]
        still = float(refine_panels(moving, self.edges()).integrals.sum()) if self.parts else 0.0
        return still + float(sum(shares))

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
                raise ZeroDivisionError  # the process can be predicted exactly
            values = np.log(ratio) if noiseless else np.log1p(ratio)
            return np.asarray(values[:, None] * self.inner.weights(x))

        try:
            return refine_panels(integrand, self.edges(ends), floor=1e-14 if noiseless else 0.0)
        except ZeroDivisionError:
            return None


def decoupled_modes(
    hardware: LoopHardware,
    noise_nm2: FloatArray,
    turbulence: Sequence[Spectrum | None],
    vibrations: Sequence[tuple[FloatArray, Vibration]],
    directions: Sequence[FloatArray] = (),
    *,
    in_image: bool,
    sinusoids: Sequence[tuple[FloatArray, SinusoidalVibration]] = (),
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
    inner, modes = InnerFactor.of(hardware, in_image=in_image), []
    for axis in axes:
        key = next(key for key, projector in groups.items() if axis @ projector @ axis > 0.5)
        lines = [line.ar_model(rate) for along, line in vibrations if abs(along @ axis) > 0.5]
        parts = tuple(part for part in (kinds[key], *lines) if part is not None)
        seen = tuple((s.frequency_hz, s.rms_nm * float(along @ axis)) for along, s in sinusoids)
        variance = max(float(axis @ noise @ axis), 0.0)
        mode = ModeSpectrum(inner, rate, parts, variance, in_image, seen)
        late = in_image and hardware.delay_frames % 1 > 0
        modes.append(mode.interpolated(hardware.delay_frames) if late else mode)
    return axes, modes


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
