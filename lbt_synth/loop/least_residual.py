"""The least residual of any linear controller, by spectral factorisation.

It uses no design and no closed loop, and so is an independent check of them. With the measured
spectrum ``Phi = S + R = |F|^2``, F outer, and a path of d whole frames from a filter's output to
the residual, the least variance is that of the first d coefficients of F, less R; a fraction up to
a half changes nothing, as its factor has a stable inverse. All that is needed of F are integrals of
``log Phi`` times cosines. In the image a command of a settled mirror corrects the mean over its own
hold, whatever part of a frame it comes late by: that mean is interpolated between the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.linalg import solve_triangular, toeplitz

from lbt_synth.errors import CoupledModesError, LbtSynthError, ProblemError
from lbt_synth.linear.quadrature import RefinedPanels, graded_edges, refine_panels
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.models import ARModel, LoopHardware, Spectrum, TipTiltPlant, Truth, Vibration
from lbt_synth.models.loop_hardware import require_loop_rate
from lbt_synth.models.spectra import breakpoints_below, spectrum_density
from lbt_synth.models.vibration import checked_direction
from lbt_synth.validation import FloatArray, definite, frozen_copy, read_only, require_instance

T = TypeVar("T")
POINTS = 16  # samples on each side of one between two samples
_INDEPENDENT = 1e-13  # part of the largest eigenvalue of a covariance that is more than rounding
_COUPLING = 1e-9  # relative size above which an off-diagonal entry counts as coupling


@dataclass(frozen=True, slots=True, eq=False)
class Interpolation:
    """A sample between two others, as the best sum over those around it: ``sum p[i] m(k + i)``.

    What the sum misses is orthogonal to the samples, so that nobody predicts it.
    """

    first: int  # first sample of the sum
    weights: FloatArray  # (2 POINTS,)
    missed: float  # variance of what the sum misses

    @staticmethod
    def lags(samples: float) -> FloatArray:
        """Return the lags of which :meth:`of` takes the covariances: of the samples, then to it."""
        first = int(samples) - POINTS + 1
        return np.concatenate([np.arange(2 * POINTS), samples - first - np.arange(2 * POINTS)])

    @staticmethod
    def of(samples: float, covariances: FloatArray) -> Interpolation:
        """Return the sample that comes a fraction of samples after the newest one."""
        among, to_it = np.split(covariances, 2)
        gram = toeplitz(among)
        values, vectors = np.linalg.eigh(gram)
        inverse = np.where(values > _INDEPENDENT * values[-1], 1 / np.maximum(values, 1e-300), 0.0)
        weights = vectors @ (inverse * (vectors.T @ to_it))
        missed = among[0] - 2 * weights @ to_it + weights @ gram @ weights
        return Interpolation(int(samples) - POINTS + 1, weights, max(float(missed), 0.0))

    def variance(self, coefficients: FloatArray, sigma2: float, noise: float) -> float:
        """Least variance of its error, for ``F = sigma (1 + f_1 z^-1 + ...)`` of ``|F|^2 = Phi``.

        With the white noise R on the samples that are seen, the sum P, and ``F*`` the conjugate,
        the error of Wiener's filter is ``|[P F - R P / F*]_+|^2`` over powers above 0, and
        ``|P|^2 (R - R^2 / Phi)``. All but the finite sums over powers up to 0 cancels.
        """
        p, first = self.weights, self.first
        steps = toeplitz(coefficients, 0 * coefficients)
        inverse = solve_triangular(steps, np.eye(1, p.size)[0], lower=True)  # of 1 / (1 + f_1 x ..)
        powers = first + np.arange(p.size)
        forward = np.array([p[i:] @ coefficients[: p.size - i] for i in range(p.size)])
        backward = np.array([p[: i + 1] @ inverse[i::-1] for i in range(p.size)])
        past = powers <= 0
        error = sigma2 * np.sum(forward[~past] ** 2) - noise * np.sum(p**2)
        error += 2 * noise * np.sum(forward[past] * backward[past])
        return float(error - noise**2 / sigma2 * np.sum(backward[past] ** 2)) + self.missed


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Best prediction of a process whose spectrum has given integrals of its logarithm."""

    mean_log: float  # mean of ``log(Phi / R)``
    coefficients: FloatArray  # ``1, f_1, ...`` of ``F = sigma (1 + f_1 z^-1 + ...)``
    target: Interpolation | None  # what is predicted, where it is not one sample

    def variance(self, noise: float) -> float:
        """Least variance of the residual, for a noise of variance R."""
        sigma2 = np.exp(self.mean_log)
        if self.target is not None:
            return self.target.variance(self.coefficients, noise * sigma2, noise)
        later = float(np.sum(self.coefficients[1:] ** 2))
        # sums of positive numbers: no digits are lost however large the noise
        return float(noise * (np.expm1(self.mean_log) + sigma2 * later))

    def error_power(self, x: FloatArray) -> FloatArray:
        """``|P|^2 / sigma^2`` at frequencies x: the rejection is ``|P / F|^2``."""
        if self.target is not None:
            raise ProblemError(
                "the limit over a band is known for whole frames of delay; got a fraction."
            )
        return np.asarray(np.abs(polyval(np.exp(-1j * np.pi * x), self.coefficients)) ** 2)


def _exponential(c: FloatArray) -> FloatArray:
    """As many coefficients of ``exp(c_1 x + c_2 x^2 + ...)`` as there are of c."""
    f = np.zeros(c.size)
    f[0] = 1.0
    weighted = np.arange(c.size) * c
    for n in range(1, c.size):
        f[n] = weighted[1 : n + 1] @ f[n - 1 :: -1][:n] / n
    return f


@dataclass(frozen=True, slots=True, eq=False)
class ModeSpectrum:
    """One decoupled mode: its disturbance and the white noise on its measurement."""

    frames: int  # of whole delay from the measured sample to the corrected one
    rate_hz: float
    parts: tuple[Spectrum, ...]  # independent parts of the disturbance
    noise_nm2: float  # variance of the noise per frame, as a phase [nm^2]
    in_image: bool  # whether spectra are of all moments, of which frames have the means
    sinusoids: tuple[tuple[float, float], ...] = ()  # frequency [Hz] and rms [nm] of each
    target: Interpolation | None = None  # what is corrected, where it is not one sample

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
        return replace(self, target=Interpolation.of(delay_frames, moments))

    def cosines(self, x: FloatArray) -> FloatArray:
        """Weights (f, k) of the logarithm at frequencies x, in units of Nyquist."""
        count = self.frames if self.target is None else 2 * POINTS
        return np.asarray(np.cos(np.pi * np.arange(count) * x[:, None]))

    def predicted(self, moments: FloatArray) -> Prediction:
        """Return the best prediction, by the integrals of the logarithm times the cosines."""
        return Prediction(float(moments[0]), _exponential(moments), self.target)

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
        """First panels of (0, 1), short at lines and kinks."""
        models = [part for part in self.parts if isinstance(part, ARModel)]
        poles = [np.linalg.eigvals(model.companion).astype(np.complex128) for model in models]
        kinks = [breakpoints_below(part, self.rate_hz / 2) for part in self.parts]
        grid = graded_edges(np.concatenate([np.zeros(0, np.complex128), *poles]))
        points = np.unique(np.concatenate([grid, *(2 / self.rate_hz * kink for kink in kinks)]))
        keep = np.concatenate([[True], np.diff(points) > 1e-12])
        return np.unique(np.concatenate([points[keep], [1.0], np.array(extra, dtype=float)]))

    def log_moments(self, ends: Sequence[float] = ()) -> RefinedPanels:
        """Integrals of ``log(Phi / R)`` times the cosines; the two ``ends`` are edges of panels."""

        def integrand(x: FloatArray) -> FloatArray:
            with np.errstate(over="ignore"):
                ratio = self.power(x) / self.noise_nm2
            if not np.all(np.isfinite(ratio)):
                raise ProblemError(
                    f"the noise variance {self.noise_nm2:.3g} nm^2 is too small beside the "
                    "disturbance to differ from zero. Give noise_nm a size that sensors have."
                )
            return np.asarray(np.log1p(ratio)[:, None] * self.cosines(x))

        return refine_panels(integrand, self.edges(ends))


def truth_modes(
    hardware: LoopHardware,
    truth: Truth | TipTiltPlant,
    directions: Sequence[FloatArray] = (),
    *,
    in_image: bool,
) -> tuple[FloatArray, list[ModeSpectrum]]:
    """Rotate the modes until what disturbs them, and the noise on them, are diagonal.

    Return the directions over the modes (rows) and the spectrum along each. Further ``directions``
    (n,) must be axes, too.
    """
    gain = truth.sensor_gain if isinstance(truth, Truth) else 1.0
    groups, vibrations, factor = truth.entering(hardware, sensor_gain=gain)
    noise_nm2 = factor @ factor.T / gain**2
    if hardware.suite.sensors:
        raise ProblemError(
            "the limit is that of the loop's own sensor; got others beside it. Take "
            "hardware.own_sensor_alone()."
        )
    n, rate = hardware.modes, hardware.frame_rate_hz
    noise = _noise_on_modes(hardware, noise_nm2)
    for spectrum, _ in groups:
        if isinstance(spectrum, ARModel):
            require_loop_rate(spectrum.frame_rate_hz, hardware)
    calm = sorted(set(range(n)).difference(*(members for _, members in groups)))
    # modes with the same spectrum may be turned into each other
    air = [*groups, *([(None, calm)] if calm else [])]
    lines = []
    for vibration in vibrations:
        along, means = checked_direction(vibration, hardware), vibration
        if isinstance(vibration, Vibration) and in_image and not truth.is_of_means:
            share = float(np.sinc(vibration.frequency_hz / rate))  # frames have its mean
            means = replace(vibration, rms_nm=share * vibration.rms_nm)
        lines.append((along, means))
    axes = _common_axes(
        [
            noise,
            *(np.diag(np.isin(range(n), some) * 1.0) for _, some in air),
            *(np.outer(along, along) for along, line in lines if isinstance(line, Vibration)),
            *(np.outer(along, along) for along in directions),
        ]
    )
    if hardware.mirror is not None:
        raise ProblemError("a limit is known for a mirror that settles at once; got dynamics.")
    if hardware.delay_frames % 1 > 0.5 and not in_image:  # a zero outside the unit circle
        raise ProblemError(
            "the limit of means over frames is known for at most a half beyond whole frames of "
            f"delay; got {hardware.delay_frames:g}. Take that in the image."
        )
    frames, modes = int(hardware.delay_frames), []
    for axis in axes:
        parts = [next(spectrum for spectrum, some in air if np.sum(axis[some] ** 2) > 0.5)]
        sinusoids = []
        for along, line in lines:
            if not isinstance(line, Vibration):
                sinusoids.append((line.frequency_hz, line.rms_nm * float(along @ axis)))
            elif abs(along @ axis) > 0.5:
                parts.append(line.ar_model(rate))
        mode = ModeSpectrum(
            frames,
            rate,
            tuple(part for part in parts if part is not None),
            max(float(axis @ noise @ axis), 0.0),
            in_image,
            tuple(sinusoids),
        )
        late = in_image and hardware.delay_frames > frames
        modes.append(mode.interpolated(hardware.delay_frames) if late else mode)
    return axes, modes


def _noise_on_modes(hardware: LoopHardware, noise_nm2: FloatArray) -> FloatArray:
    """Covariance (n, n) of the best unbiased estimate of the modes from one measurement."""
    n = hardware.modes
    rows = ("sensor", "see", hardware.sensor), ("mirror", "reach", hardware.influence)
    for device, verb, matrix in rows:
        if (rank := np.linalg.matrix_rank(matrix)) < n:
            raise ProblemError(
                f"the {device} must {verb} every mode; got a matrix of rank {rank} for {n} modes. "
                f"Leave out the modes that it does not {verb}."
            )
    size = float(np.max(np.abs(noise_nm2))) or 1.0
    covariance = definite(noise_nm2 / size, "the covariance of the noise on all measurements")
    white = np.linalg.solve(np.linalg.cholesky(covariance), hardware.sensor)
    return np.asarray(size * np.linalg.inv(white.T @ white))


def _common_axes(matrices: Sequence[FloatArray]) -> FloatArray:
    """Orthonormal rows that make all symmetric matrices diagonal."""
    unit = np.array([m / max(float(np.linalg.norm(m, 2)), 1e-300) for m in matrices])

    def couple(axes: FloatArray) -> bool:
        turned = axes @ unit @ axes.T
        return bool(np.max(np.abs(turned * (1 - np.eye(len(axes))))) > _COUPLING)

    plain = np.eye(len(matrices[0]))
    if not couple(plain):
        return plain
    # matrices that commute share the eigenvectors of almost every sum of them
    shares = np.random.default_rng(0).uniform(1, 2, len(unit))
    axes = np.linalg.eigh(np.tensordot(shares, unit, 1))[1].T
    largest = np.argmax(np.abs(axes), axis=1)
    axes = axes * np.sign(axes[np.arange(len(axes)), largest])[:, None]
    axes = axes[np.argsort(largest, kind="stable")]
    if couple(axes):
        raise CoupledModesError(
            "a limit needs modes that decouple: vibrations parallel or at right angles to each "
            "other, along principal axes of the sensor's noise and within modes of one turbulence. "
            "Turn the directions, take equal noise on all modes, or treat each mode by itself."
        )
    return np.asarray(axes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualLimit:
    """The least residual of any linear controller."""

    variance_nm2: FloatArray  # (n,): least variance along each direction [nm^2]
    within_nm2: FloatArray  # (n,): the part of it that moves within frames [nm^2]
    # (n, n): directions over the modes, one per row, along which the loop decouples
    directions: FloatArray

    @property
    def rms_nm(self) -> float:
        """Least residual over all modes [nm rms]."""
        return float(np.sqrt(np.sum(self.variance_nm2)))


def least_residual(
    hardware: LoopHardware, truth: Truth | TipTiltPlant, *, frame_means: bool = False
) -> ResidualLimit:
    """Least stationary residual that any linear controller leaves under a truth, in the image.

    By spectral factorisation, without any design: a controller that knew the spectra, the
    noise and the sensor gain could come as close to it as it likes, none could pass it.
    Of sinusoids there remains what moves within a frame, since no command follows it: one frequency
    can be rejected entirely at a price as small as one likes. Random vibrations count with their
    spectra.

    Parameters
    ----------
    hardware : LoopHardware
        The loop, with any delay. The sensor must see and the mirror reach every mode.
    truth : Truth or TipTiltPlant
        Disturbances, noise and sensor gain, or a plant whose model is the truth. Coupled modes of a
        plant have a limit, too, at whole frames of delay and a mirror that settles at once.
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
        not fit the loop; also for other sensors, for a mirror with dynamics, and in means over
        frames where a delay ends in the second half of a frame.
    NumericalError
        If an integral over a spectrum does not settle.

    Examples
    --------
    An AR1 process with hardly any noise, predicted over two frames:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.5], driving_rms_nm=2.0, frame_rate_hz=800)
    >>> limit = lbt.loop.least_residual(
    ...     path, lbt.Truth(turbulence=slow, noise_nm=1e-6), frame_means=True
    ... )
    >>> round(float(limit.variance_nm2[0]), 8)  # 2^2 (1 + 0.5^2)
    5.0
    """
    require_instance(hardware, LoopHardware)
    if not hasattr(truth, "entering"):
        require_instance(truth, Truth)
    try:
        axes, modes = truth_modes(hardware, truth, in_image=not frame_means)
    except CoupledModesError:
        late = hardware.mirror is not None or hardware.delay_frames % 1
        if isinstance(truth, Truth) or late:
            raise
        return _coupled_limit(truth, in_image=not frame_means)
    within = np.array([mode.within_frames_nm2() for mode in modes])
    return ResidualLimit(
        variance_nm2=read_only(within + [mode_limit(mode) for mode in modes]),
        within_nm2=read_only(within),
        directions=frozen_copy(axes),
    )


def _coupled_limit(plant: TipTiltPlant, *, in_image: bool) -> ResidualLimit:
    """Return the error of the best estimate, from a Riccati equation, and what frames hide."""
    n, rate = plant.hardware.modes, plant.hardware.frame_rate_hz
    within = np.zeros((n, n))
    parts = list(zip(np.eye(n), plant.turbulence, strict=True))
    parts += [(checked_direction(v, plant.hardware), v.ar_model(rate)) for v in plant.vibrations]
    for along, model in parts:
        mode = ModeSpectrum(0, rate, (model,), 0.0, in_image)
        within += mode.within_frames_nm2() * np.outer(along, along)
    error = plant.L @ kalman_riccati(plant).P @ plant.L.T
    variance, axes = np.linalg.eigh(error + within)
    return ResidualLimit(
        variance_nm2=frozen_copy(variance),
        within_nm2=frozen_copy(np.einsum("in,ij,jn->n", axes, within, axes)),
        directions=frozen_copy(axes.T),
    )


def mode_limit(mode: ModeSpectrum) -> float:
    """Least variance of the means of one mode."""
    if not mode.parts:
        return 0.0
    moments = mode.log_moments().integrals.sum(axis=0)
    return mode.predicted(moments).variance(mode.noise_nm2)


def above_percent(rms_nm: float, limit_nm: float) -> float:
    """Return how far a residual is above a limit [%]; nan where the limit is 0 or nan."""
    return 100 * (rms_nm / limit_nm - 1) if limit_nm > 0 else np.nan


def limit_or_none(limit: Callable[[], T]) -> T | None:
    """Return the limit, None where it cannot be computed."""
    try:
        return limit()
    except LbtSynthError:
        return None
