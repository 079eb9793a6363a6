"""Residual variance from a measured residual, without its noise and with a standard error.

For Gaussian series the covariance of two mean squares over K frames is ``2 / K`` times the sum
of the squared cross-covariances over all lags (M. S. Bartlett, J. Roy. Stat. Soc. Suppl. 8, 27
(1946), doi:10.2307/2983611), which is the mean of the squared cross-spectrum. A periodogram I has
``E I^2 = 2 S^2``: no spectrum needs to be smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import rfft

from lbt_synth.errors import ProblemError
from lbt_synth.identification.stretches import Stretches
from lbt_synth.loop import Imaging, jitter_strehl
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy

_FEWEST = 100  # frames that give a standard error
_TOO_FAR = 4.0  # standard errors below zero that chance does not explain


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualEstimate:
    """Residual of a loop, estimated from the measured residual ``phi_res(k-1) + noise``.

    The variance of the noise is subtracted: an estimate may be negative within its error. Its rms
    is then nan, and :attr:`upper_nm` an upper bound. One that is negative by more refutes the
    noise that was subtracted (:attr:`refuted`).

    Attributes
    ----------
    measured_nm : (frames, n) ndarray
        Measured residual e(k) of the frames that count [nm].
    stretches : tuple of (start, stop)
        Where in the record they are.
    noise_nm2 : (n, n) ndarray
        Covariance of the noise in e [nm^2].
    covariance_nm2 : (n, n) ndarray
        Covariance of the residual: mean of ``e e'`` less that of the noise [nm^2].
    error_nm4 : (n, n) ndarray
        Covariance of the errors of the axes' variances [nm^4].
    """

    measured_nm: FloatArray
    stretches: Stretches
    noise_nm2: FloatArray
    covariance_nm2: FloatArray
    error_nm4: FloatArray

    @property
    def variance_nm2(self) -> FloatArray:
        """Residual variance of each axis, (n,) [nm^2]; may be negative within its error."""
        return frozen_copy(np.diag(self.covariance_nm2))

    @property
    def variance_error_nm2(self) -> FloatArray:
        """Standard error of each axis' variance, (n,) [nm^2]."""
        return frozen_copy(np.sqrt(np.diag(self.error_nm4)))

    @property
    def total_nm2(self) -> float:
        """Residual variance over all axes [nm^2]."""
        return float(np.sum(self.variance_nm2))

    @property
    def total_error_nm2(self) -> float:
        """Standard error of the variance over all axes [nm^2]."""
        return float(np.sqrt(max(float(np.sum(self.error_nm4)), 0.0)))

    @property
    def axis_rms_nm(self) -> FloatArray:
        """Residual of each axis, (n,) [nm rms]; nan where the variance is negative."""
        return frozen_copy(_roots(self.variance_nm2))

    @property
    def axis_rms_error_nm(self) -> FloatArray:
        """Standard error of each axis' rms, (n,) [nm]; nan where the variance is negative."""
        with np.errstate(divide="ignore"):
            return frozen_copy(self.variance_error_nm2 / (2 * self.axis_rms_nm))

    @property
    def rms_nm(self) -> float:
        """Residual over all axes [nm rms]; nan where the variance is negative."""
        return float(_roots(np.array(self.total_nm2)))

    @property
    def rms_error_nm(self) -> float:
        """Standard error of the rms [nm]; nan where the variance is negative."""
        return self.total_error_nm2 / (2 * self.rms_nm) if self.total_nm2 > 0 else float("nan")

    @property
    def errors_below_zero(self) -> float:
        """Standard errors by which the variance, over all axes or of one, is below zero."""
        below = -np.append(self.variance_nm2, self.total_nm2)
        error = np.append(self.variance_error_nm2, self.total_error_nm2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.max(np.where(below > 0, below / error, 0.0)))

    @property
    def refuted(self) -> bool:
        """Whether more noise was subtracted than there is, by more than four standard errors."""
        return self.errors_below_zero > _TOO_FAR

    @property
    def upper_nm(self) -> float:
        """Root of the variance plus two standard errors, at least 0 [nm rms]; nan if refuted."""
        if self.refuted:
            return float("nan")
        return float(np.sqrt(max(self.total_nm2 + 2 * self.total_error_nm2, 0.0)))

    def above(self, other: ResidualEstimate) -> tuple[float, float]:
        """Variance of this residual less that of another on the same frames, and its error.

        The noise and most of the disturbance cancel: the error is smaller than that of either.

        Parameters
        ----------
        other : ResidualEstimate
            Another loop's residual, of the same frames and noise.

        Returns
        -------
        tuple of float
            Difference and standard error [nm^2].

        Raises
        ------
        ProblemError
            If the frames are others.
        """
        if self.stretches != other.stretches or self.measured_nm.shape != other.measured_nm.shape:
            raise ProblemError("two residuals can be compared on the same frames only; got others.")
        covariance = _mean_covariance(
            self.measured_nm - other.measured_nm,
            self.measured_nm + other.measured_nm,
            self.stretches,
        )
        error = float(np.sqrt(max(float(np.sum(covariance)), 0.0)))
        return self.total_nm2 - other.total_nm2, error

    def strehl(self, imaging: Imaging) -> float:
        """Strehl ratio of a Gaussian residual of this covariance.

        Parameters
        ----------
        imaging : Imaging
            The camera.

        Returns
        -------
        float
            Long-exposure Strehl ratio, in [0, 1]; nan if the covariance is not positive
            semidefinite, because the residual is lost in the noise.
        """
        if np.linalg.eigvalsh(self.covariance_nm2)[0] < 0:
            return float("nan")
        return jitter_strehl(self.covariance_nm2, imaging=imaging)


def _roots(variance: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.where(variance >= 0, variance, np.nan)), dtype=np.float64)


def estimate_residual(
    measured: FloatArray, stretches: Stretches, noise_nm2: FloatArray, noise_error_nm4: FloatArray
) -> ResidualEstimate:
    """Estimate a residual from the measured residual (frames, n) of some stretches."""
    if len(measured) < _FEWEST:
        raise ProblemError(
            f"a residual needs at least {_FEWEST} frames after settling; got {len(measured)}. "
            "Give longer stretches, or lower settle_frames."
        )
    error = _mean_covariance(measured, measured, stretches) + noise_error_nm4
    return ResidualEstimate(
        measured_nm=frozen_copy(measured),
        stretches=stretches,
        noise_nm2=frozen_copy(noise_nm2),
        covariance_nm2=frozen_copy(measured.T @ measured / len(measured) - noise_nm2),
        error_nm4=frozen_copy(error),
    )


def _mean_covariance(one: FloatArray, other: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the covariance over the axes of mean products of two Gaussian series, (n, n).

    ``cov(x_i y_i, x_j y_j)`` over all lags is the mean over the frequencies of ``S(x_i, x_j)
    conj S(y_i, y_j) + S(x_i, y_j) conj S(y_i, x_j)``. On the diagonal the product of the two
    periodograms has that mean for x = y, and at least that otherwise; off it, the two factors
    are taken at neighbouring frequencies, which are independent.
    """
    frames, n = one.shape
    total, start = np.zeros((n, n)), 0
    for begin, end in stretches:
        length = end - begin
        x, y = (rfft(series[start : start + length], axis=0) for series in (one, other))
        weight = np.full(len(x), 2.0)  # a frequency and its negative
        weight[0] = 1.0
        weight[-1] = 2.0 if length % 2 else 1.0
        weight /= length**2
        part = _products(x, x) * np.roll(_products(y, y).conj(), 1, axis=0)
        part += _products(x, y) * np.roll(_products(y, x).conj(), 1, axis=0)
        lower = np.tril(np.tensordot(weight, part.real, 1), -1)
        total += lower + lower.T + np.diag(weight @ (np.abs(x) ** 2 * np.abs(y) ** 2))
        start += length
    total /= frames**2
    # a covariance is at most the product of the deviations
    most = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    return np.asarray(np.clip(total, -most, most))


def _products(x: ComplexArray, y: ComplexArray) -> ComplexArray:
    """Return ``x_i conj(y_j)`` at each frequency, (f, n, n)."""
    return x[:, :, None] * y.conj()[:, None, :]
