"""The residual that a controller would have left of a recorded disturbance.

The pseudo-open-loop measurement ``z(k) = phi_tot(k-1) + S^-1 w(k)`` does not depend on the
controller that ran. From ``y(k) = S (z(k) - c(k))``, with c(k) its own correction, another one
computes exactly the commands of that loop. Its measured residual is ``e(k) = z(k) - c(k) =
phi_res(k-1) + S^-1 w(k)``; c(k) depends on the noise up to frame k-1 only, so white noise adds
exactly its variance, which is subtracted.

The state of a loop at the beginning of contiguous frames depends on the frames before, which are
not known. A replay begins in the equilibrium for the mean of the first half second of a stretch,
which does not count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import rfft

from lbt_synth.errors import ProblemError
from lbt_synth.identification.records.faults import SURPRISING
from lbt_synth.identification.records.record import Stretches, cut_stretches
from lbt_synth.linear import StateSpace
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop import ClosedLoop, Imaging, strehl
from lbt_synth.models import LoopHardware
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, one_or_each

MUCH = 1.25  # ratio of residuals that no error excuses: that of a line that beats is too large
_ERRORS = 2.0  # standard errors by which one residual is clearly above another
_LEAST_SHARE = 0.02  # of the measured variance: 1 % of the rms, less than conditions change by
_SEGMENT = 256  # frames of a spectrum: 4 Hz at 1 kHz, as finely as an excess is told
_SETTLE_S = 0.5  # of a stretch, in which loops that reject a hertz forget where they began


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualEstimate:
    """Residual of a loop, estimated from the measured residual ``phi_res(k-1) + noise``.

    The variance of the noise is subtracted: an estimate may be negative within its error. Its rms
    is then nan, and :attr:`upper_nm` an upper bound. One that is negative by more refutes the
    noise (:attr:`refuted`).
    """

    measured_nm: FloatArray  # (frames, n): measured residual e(k) of the frames that count
    stretches: Stretches  # where in the record they are
    noise_nm2: FloatArray  # (n, n): covariance of the noise in e
    covariance_nm2: FloatArray  # (n, n): mean of ``e e'`` less that of the noise
    error_nm4: FloatArray  # (n, n): covariance of the errors of the axes' variances

    @property
    def variance_nm2(self) -> FloatArray:
        """Residual variance of each axis, (n,) [nm^2]; may be negative within its error."""
        return frozen_copy(np.diag(self.covariance_nm2))

    @property
    def total_nm2(self) -> float:
        """Residual variance over all axes [nm^2]."""
        return float(np.sum(self.variance_nm2))

    @property
    def measured_nm2(self) -> float:
        """Mean square of the measured residual over all axes, noise included [nm^2]."""
        return self.total_nm2 + float(np.trace(self.noise_nm2))

    @property
    def total_error_nm2(self) -> float:
        """Standard error of the variance over all axes [nm^2]."""
        return float(np.sqrt(max(float(np.sum(self.error_nm4)), 0.0)))

    @property
    def rms_nm(self) -> float:
        """Residual over all axes [nm rms]; nan where the variance is negative."""
        return float(np.sqrt(self.total_nm2)) if self.total_nm2 >= 0 else float("nan")

    @property
    def rms_error_nm(self) -> float:
        """Standard error of the rms [nm]; nan where the variance is negative."""
        return self.total_error_nm2 / (2 * self.rms_nm) if self.total_nm2 > 0 else float("nan")

    @property
    def refuted(self) -> bool:
        """Whether the variance, over all axes or of one, is four standard errors below zero."""
        variance = np.append(self.variance_nm2, self.total_nm2)
        error = np.append(np.sqrt(np.diag(self.error_nm4)), self.total_error_nm2)
        return bool(np.any(variance < -SURPRISING * error))

    @property
    def upper_nm(self) -> float:
        """Root of the variance plus two standard errors, at least 0 [nm rms]; nan if refuted."""
        upper = max(self.total_nm2 + 2 * self.total_error_nm2, 0.0)
        return float("nan") if self.refuted else float(np.sqrt(upper))

    @property
    def hidden(self) -> bool:
        """Whether the noise hides it: the variance is not above its standard error."""
        return self.total_nm2 <= self.total_error_nm2

    @property
    def safe_nm2(self) -> float:
        """Variance by which designs are chosen: its bound where the noise hides it [nm^2]."""
        return self.total_nm2 + 2 * self.total_error_nm2 * self.hidden

    def above(self, other: ResidualEstimate) -> tuple[float, float]:
        """Return how far the variance is above another residual's, and the standard error [nm^2].

        On the same frames, which alone are allowed, the noise and most of the disturbance cancel:
        the error is smaller than that of either.
        """
        one, two = self.measured_nm, other.measured_nm
        if self.stretches != other.stretches or one.shape != two.shape:
            raise ProblemError("two residuals can be compared on the same frames only; got others.")
        covariance = mean_covariance(one - two, one + two, self.stretches)
        error = float(np.sqrt(max(float(np.sum(covariance)), 0.0)))
        return self.total_nm2 - other.total_nm2, error

    def is_clearly_above(self, other: ResidualEstimate) -> bool:
        """Whether it is above another residual by more than chance and changing conditions do.

        Two standard errors of the difference are chance, if they are no more than 25 % of the rms.
        """
        difference, error = self.above(other)
        excused = (MUCH**2 - 1) * max(other.total_nm2, other.total_error_nm2)
        return difference > max(_LEAST_SHARE * self.measured_nm2, min(_ERRORS * error, excused))

    def excess_band(self, other: ResidualEstimate) -> tuple[float, float]:
        """Return the band around the largest excess of power over another residual [1/frame]."""
        from scipy.signal import welch  # slow to import

        powers = (welch(one.measured_nm, nperseg=_SEGMENT, axis=0)[1] for one in (self, other))
        more = np.subtract(*(np.sum(power, axis=1) for power in powers))
        peak, below = int(np.argmax(more)), np.flatnonzero(more < np.max(more) / 2)
        low = max(below[below < peak], default=-1)
        high = min(below[below > peak], default=len(more))
        return (low + 0.5) / _SEGMENT, (high - 0.5) / _SEGMENT

    def parts(self, count: int) -> list[ResidualEstimate]:
        """Return the residuals of so many consecutive parts of the frames, of equal length."""
        edges = (len(self.measured_nm) * np.arange(count + 1) // count).tolist()
        none = np.zeros_like(self.noise_nm2)
        return [
            estimate_residual(
                self.measured_nm[a:b], cut_stretches(self.stretches, a, b), self.noise_nm2, none
            )
            for a, b in pairwise(edges)
        ]

    def strehl(self, imaging: Imaging) -> float:
        """Long-exposure Strehl ratio of a Gaussian residual of this covariance, in [0, 1].

        It is nan where the noise hides the residual, or is refuted; a variance of one axis below
        zero counts as zero.
        """
        if self.refuted or self.hidden:
            return float("nan")
        values, vectors = np.linalg.eigh(self.covariance_nm2)
        covariance = vectors * np.maximum(values, 0.0) @ vectors.T
        return float(strehl(covariance, imaging))

    @property
    def text(self) -> str:
        """The residual in words, with its error, or with its bound where the noise hides it."""
        if self.refuted:
            return "an unknown residual (the model has more noise than the data)"
        if self.hidden:
            return f"at most {nm_text(self.upper_nm)} (the noise hides it)"
        return nm_text(self.rms_nm, error_nm=self.rms_error_nm)


def estimate_residual(
    measured: FloatArray, stretches: Stretches, noise_nm2: FloatArray, noise_error_nm4: FloatArray
) -> ResidualEstimate:
    """Estimate a residual from the measured residual (frames, n) of some stretches."""
    return ResidualEstimate(
        measured_nm=frozen_copy(measured),
        stretches=stretches,
        noise_nm2=frozen_copy(noise_nm2),
        covariance_nm2=frozen_copy(measured.T @ measured / len(measured) - noise_nm2),
        error_nm4=frozen_copy(mean_covariance(measured, measured, stretches) + noise_error_nm4),
    )


def mode_noise(
    hardware: LoopHardware, noise_nm2: FloatArray, noise_error_nm: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return noise (q, q) of the measurements in the modes [nm^2], and its error [nm^4], (n, n).

    The error of a measurement's noise is common to all modes that it measures.
    """
    back = inverse_sensor(hardware)
    error = one_or_each(noise_error_nm, "noise_error_nm", hardware.n_measurements, at_least=0)
    deviation = np.sqrt(np.diag(noise_nm2))
    # d var_i / d s_j; of white noise without correlations 2 s_j back_ij^2
    slope = 2 * back * (back @ noise_nm2) / np.where(deviation > 0, deviation, np.inf)
    return back @ noise_nm2 @ back.T, (slope * error**2) @ slope.T


def inverse_sensor(hardware: LoopHardware) -> FloatArray:
    """Return the inverse of the sensor matrix, (n, n); refuse one that has none."""
    square = hardware.sensor
    rank = np.linalg.matrix_rank(square)
    if square.shape[0] != square.shape[1] or rank < len(square):
        raise ProblemError(
            "a replay needs a measurement for every mode, and a sensor matrix that can be "
            f"inverted; got {square.shape} of rank {rank}."
        )
    return np.asarray(np.linalg.inv(square))


def settled_test(runs: Stretches, test: Stretches, hardware: LoopHardware) -> Stretches:
    """Return the frames of a test within runs that count: not those of the first half second."""
    settle, kept = settle_frames(hardware), []
    for start, stop in test:
        first = next(a for a, b in runs if a <= start and stop <= b)
        if first + settle < stop:
            kept.append((max(start, first + settle), stop))
    if (frames := sum(stop - start for start, stop in kept)) < settle:
        raise ProblemError(
            f"a residual needs at least {settle} frames beyond the first {settle} of each stretch; "
            f"got {frames}. Record more, or split less."
        )
    return tuple(kept)


def settle_frames(hardware: LoopHardware) -> int:
    """Return the frames in which a loop forgets where it began."""
    return max(round(_SETTLE_S * hardware.frame_rate_hz), 1)


def gather(series: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the rows of a series (frames, n) that lie in some stretches."""
    return np.concatenate([series[start:stop] for start, stop in stretches])


def replay(
    loop: ClosedLoop, series: FloatArray, runs: Stretches, readings: FloatArray | None = None
) -> FloatArray:
    """Return the measured residual (frames, n) of a stable loop on a series, nan outside of runs.

    z(k) stands for phi_tot(k-1), without noise: the residual of frame k-1 is e(k). A loop that
    reads channels is given their readings (frames, c), which come in the frame of the measurement.
    """
    path, driven = loop.path("phase", "residual"), series
    if loop.reads_others and readings is not None:
        path, n = loop.path("all", "residual"), loop.hardware.modes
        entering = np.r_[:n, n + loop.hardware.n_measurements : path.B.shape[-1]]
        path = replace(path, B=path.B[..., entering], D=path.D[..., entering])
        driven = np.hstack([series, np.vstack([readings[:1], readings[:-1]])])
    return run_from_rest(path, driven, runs, settle_frames(loop.hardware))


def run_from_rest(path: StateSpace, driven: FloatArray, runs: Stretches, first: int) -> FloatArray:
    """Return the outputs of a system, nan outside of runs, which begin in its equilibrium."""
    constant = path.frequency_response([0.0])[0].real
    outputs = np.full((len(driven), len(path.C)), np.nan)
    for start, stop in runs:
        mean = np.mean(driven[start : min(stop, start + first)], axis=0)
        outputs[start:stop] = filter_series(path, driven[start:stop] - mean) + constant @ mean
    return outputs


def mean_covariance(one: FloatArray, other: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the covariance over the axes of mean products of two Gaussian series, (n, n).

    Over K frames it is ``2 / K`` times the sum of the squared cross-covariances over all lags
    (M. S. Bartlett, J. Roy. Stat. Soc. Suppl. 8, 27 (1946), doi:10.2307/2983611), the mean over the
    frequencies of ``S(x_i, x_j) conj S(y_i, y_j) + S(x_i, y_j) conj S(y_i, x_j)``. A periodogram I
    has ``E I^2 = 2 S^2``, so on the diagonal the product of the two has that mean without smoothing
    for x = y, and at least that otherwise; off it, the factors are of neighbouring frequencies.
    """
    n, start = one.shape[1], 0
    total = np.zeros((n, n))
    for length in (stop - begin for begin, stop in stretches):
        x, y = (rfft(series[start : start + length], axis=0) for series in (one, other))
        start += length
        weight = np.full(len(x), 2.0 / length**2)  # a frequency and its negative
        weight[0] /= 2
        if length % 2 == 0:
            weight[-1] /= 2
        product = _products(x, x) * np.roll(_products(y, y).conj(), 1, axis=0)
        product += _products(x, y) * np.roll(_products(y, x).conj(), 1, axis=0)
        product[:, range(n), range(n)] = np.abs(x) ** 2 * np.abs(y) ** 2
        total += np.tensordot(weight, product.real, 1)
    covariance = np.tril(total) + np.tril(total, -1).T
    covariance /= len(one) ** 2
    # a covariance is at most the product of the deviations
    most = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    return np.asarray(np.clip(covariance, -most, most))


def _products(x: ComplexArray, y: ComplexArray) -> ComplexArray:
    """Return ``x_i conj(y_j)`` at each frequency, (f, n, n)."""
    return x[:, :, None] * y.conj()[:, None, :]
