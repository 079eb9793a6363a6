"""Decoupled modes of a loop with their spectra, and the best prediction of one of them.

With the measured spectrum ``Phi = S + R = |F|^2``, F outer, and the path ``z^-1 M`` from a
filter's output to the residual written as an inner factor times an outer one, the least
variance is that of the part of F which the inner factor makes unreachable, less R. The
inner factor is ``z^-whole`` times an all-pass factor with the mirror's zeros outside the unit
circle: one for a settled mirror and a fraction of a frame above one half, one or two for a
mirror that moves slowly. The unreachable part has as many coefficients as these have zeros.
All that is needed of F are integrals of ``log Phi`` times smooth weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.linalg import toeplitz

from lbt_synth.errors import CoupledModesError, ProblemError
from lbt_synth.linear.quadrature import RefinedPanels, refine_panels
from lbt_synth.loop.closed_loop import require_loop_rate
from lbt_synth.models import ARModel, LoopHardware, SinusoidalVibration, Spectrum, Vibration
from lbt_synth.models.spectra import breakpoints_below, spectrum_density, spectrum_key
from lbt_synth.validation import ComplexArray, FloatArray

_FEW_DIGITS = 1e-2  # a division by less than this would lose more than two digits
POINTS = 16  # samples on each side of one between two samples
_INDEPENDENT = 1e-13  # part of the largest eigenvalue of a covariance that is more than rounding
_REAL = 1e-7  # relative imaginary part of what counts as a real zero
_ALIKE = 1e9  # condition of the zeros' Gram matrix beyond which they count as equal
_COUPLING = 1e-9  # relative size above which an off-diagonal entry counts as coupling


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InnerFactor:
    """The inner factor of a loop's path: a pure delay and an all-pass factor."""

    whole: int  # frames of pure delay from the measured sample to the corrected one
    zeros: tuple[float, ...]  # of the all-pass factor in the backward shift, in (-1, 1)
    terms: int  # number of cosine integrals that are needed, the mean included
    target: Interpolation | None = None  # what is corrected, where it is not one sample

    @staticmethod
    def of(hardware: LoopHardware, *, in_image: bool) -> InnerFactor:
        """Return the inner factor of a loop's path to the image, or to means over frames.

        In the image a command of a settled mirror corrects the mean over its own hold, whatever
        part of a frame it comes late by.
        """
        if in_image:
            if hardware.mirror is not None:
                raise ProblemError(
                    "the limit in the image is known for a mirror that settles at once; got one "
                    "with dynamics."
                )
            whole = int(hardware.delay_frames)
            if hardware.delay_frames == whole:
                return InnerFactor(whole=whole, zeros=(), terms=whole)
            return InnerFactor(whole=whole, zeros=(), terms=2 * POINTS)
        mirror = hardware.mirror_system
        found = mirror.core.zeros
        late = found[np.abs(found) > 1]  # on the circle: a stable inverse, in the limit
        whole = mirror.lead + 1
        if np.any(np.abs(late.imag) > _REAL * np.abs(late)):
            raise ProblemError(
                "the limit of a mirror is known for real zeros outside the unit circle; got "
                f"complex ones at {late[np.argmax(np.abs(late.imag))]:.6g}. Try another delay "
                "or frame rate, or the residual of lqg."
            )
        zeros = tuple(sorted(float(a) for a in 1 / late.real))
        if len(zeros) > 1 and np.linalg.cond(_gram(zeros)) > _ALIKE:
            raise ProblemError(
                "the limit of a mirror needs zeros outside the unit circle that differ; got "
                f"{', '.join(f'{1 / a:.9g}' for a in zeros)}. Try another delay or frame rate."
            )
        # for small zeros, the quotient (F - f_0 - ...) / zero^whole is summed as a series
        small = [abs(a) for a in zeros if abs(a) ** whole <= _FEW_DIGITS]
        more = 1 + int(np.ceil(np.log(1e-17) / np.log(max(*small, 1e-300)))) if small else 0
        return InnerFactor(whole=whole, zeros=zeros, terms=whole + more)

    @property
    def by_weight(self) -> tuple[float, ...]:
        """Zeros at which the value is an integral with a weight of its own."""
        return tuple(a for a in self.zeros if abs(a) ** self.whole > _FEW_DIGITS)

    def weights(self, x: FloatArray) -> FloatArray:
        """Weights (f, k) of the logarithm at frequencies x, in units of Nyquist."""
        columns = [np.cos(np.pi * n * x) for n in range(self.terms)]
        for a in self.by_weight:
            shifted = a * np.exp(-1j * np.pi * x)
            columns.append(np.real(shifted / (1 - shifted)))
        return np.stack(columns, axis=-1)


def _gram(zeros: tuple[float, ...]) -> FloatArray:
    """Inner products of the kernels ``1 / (1 - a z^-1)``."""
    a = np.array(zeros)
    return np.asarray(1 / (1 - np.outer(a, a)))


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
        inverse = np.zeros(coefficients.size)  # of 1 / (1 + f_1 x + ...)
        inverse[0] = 1.0
        for n in range(1, inverse.size):
            inverse[n] = -coefficients[1 : n + 1] @ inverse[n - 1 :: -1][:n]
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

    inner: InnerFactor
    mean_log: float  # mean of ``log(Phi / reference)``
    coefficients: FloatArray  # ``1, f_1, ...`` of ``F = sigma (1 + f_1 z^-1 + ...)``, (whole,)
    tails: FloatArray  # values of the later terms of F at the zeros of the all-pass factor

    @staticmethod
    def of(inner: InnerFactor, moments: FloatArray) -> Prediction:
        """Predict from the integrals of the logarithm times the weights of an inner factor."""
        f = _exponential(moments[: inner.terms])
        if inner.target is not None:
            return Prediction(inner, float(moments[0]), f, np.zeros(0))
        whole, tails = inner.whole, np.zeros(len(inner.zeros))
        for i, a in enumerate(inner.zeros):
            if a in inner.by_weight:
                value = float(np.exp(moments[inner.terms + inner.by_weight.index(a)]))
                tails[i] = (value - float(polyval(a, f[:whole]))) / a**whole
            else:
                tails[i] = float(polyval(a, f[whole:]))
        return Prediction(inner, float(moments[0]), f[:whole], tails)

    @property
    def _kernels(self) -> FloatArray:
        """Weights of the kernels ``1 / (1 - a z^-1)`` that the unreachable part is made of."""
        if not self.inner.zeros:
            return np.zeros(0)
        return np.asarray(np.linalg.solve(_gram(self.inner.zeros), self.tails))

    @property
    def later_power(self) -> float:
        """Sum of squares of all unreachable coefficients but the first, over sigma^2."""
        later = float(np.sum(self.coefficients[1:] ** 2))
        return later + max(float(self.tails @ self._kernels), 0.0)

    def variance(self, reference: float, noise: float) -> float:
        """Least variance of the residual; the reference is the noise unless that is zero."""
        sigma2 = np.exp(self.mean_log)
        if self.inner.target is not None:
            return self.inner.target.variance(self.coefficients, reference * sigma2, noise)
        if noise > 0:  # sums of positive numbers: no digits are lost however large the noise
            return float(reference * (np.expm1(self.mean_log) + sigma2 * self.later_power))
        return float(reference * sigma2 * (1 + self.later_power))

    def error_power(self, x: FloatArray) -> FloatArray:
        """``|P|^2 / sigma^2`` at frequencies x: the rejection is ``|P / F|^2``."""
        if self.inner.target is not None:
            raise ProblemError(
                "the limit over a band is known for whole frames of delay; got a fraction."
            )
        shift = np.exp(-1j * np.pi * x)
        part: ComplexArray = polyval(shift, self.coefficients)
        for a, weight in zip(self.inner.zeros, self._kernels, strict=True):
            part = part + weight * shift**self.inner.whole / (1 - a * shift)
        return np.asarray(np.abs(part) ** 2)


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
