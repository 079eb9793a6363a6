"""The residual that a controller would have left of a recorded disturbance.

The state of a loop at the beginning of contiguous frames depends on the frames before, which are
not known. A replay begins in the equilibrium for the mean of the first frames, and the first half
second of each stretch does not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import rfft

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.stretches import (
    Stretches,
    StretchesLike,
    checked_stretches,
    cut_stretches,
)
from lbt_synth.linear import Controller
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.loop import ClosedLoop, Imaging, close_loop, jitter_strehl
from lbt_synth.models import LoopHardware
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    float_array,
    frozen_copy,
    one_or_each,
    real_array,
    require_instance,
)

_TOO_FAR = 4.0  # standard errors below zero that chance does not explain
_FEWEST = 100  # frames that give a standard error
_FIRST = 64  # frames whose mean a replay begins with
_SETTLE_S = 0.5  # of a stretch, in which loops that reject a hertz forget where they began


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

        A variance below zero counts as zero; where the noise is refuted, the ratio is nan.
        """
        if self.refuted:
            return float("nan")
        values, vectors = np.linalg.eigh(self.covariance_nm2)
        covariance = vectors * np.maximum(values, 0.0) @ vectors.T
        return float(jitter_strehl(covariance, imaging=imaging))

    @property
    def text(self) -> str:
        """The residual in words, with its error, or with its bound where the noise hides it."""
        if self.refuted:
            return "an unknown residual (the model has more noise than the data)"
        if self.total_nm2 <= self.total_error_nm2:
            return f"at most {nm_text(self.upper_nm, '.2g')} (the noise hides it)"
        return nm_text(self.rms_nm, error_nm=self.rms_error_nm)


def estimate_residual(
    measured: FloatArray, stretches: Stretches, noise_nm2: FloatArray, noise_error_nm4: FloatArray
) -> ResidualEstimate:
    """Estimate a residual from the measured residual (frames, n) of some stretches."""
    error = mean_covariance(measured, measured, stretches) + noise_error_nm4
    return ResidualEstimate(
        measured_nm=frozen_copy(measured),
        stretches=stretches,
        noise_nm2=frozen_copy(noise_nm2),
        covariance_nm2=frozen_copy(measured.T @ measured / len(measured) - noise_nm2),
        error_nm4=frozen_copy(error),
    )


def replayed_residual(
    open_loop: ArrayLike,
    controller: Controller,
    hardware: LoopHardware,
    *,
    noise_nm: ArrayLike,
    noise_error_nm: ArrayLike = 0.0,
    stretches: StretchesLike | None = None,
    test: StretchesLike | None = None,
    from_rest: bool = False,
) -> ResidualEstimate:
    """Residual that a controller would have left of a recorded disturbance.

    The pseudo-open-loop measurement ``z(k) = phi_tot(k-1) + S^-1 w(k)`` does not depend on the
    controller that ran. From ``y(k) = S (z(k) - c(k))``, with c(k) its own correction, a
    controller computes exactly the commands of that loop under that disturbance and noise. Its
    measured residual is ``e(k) = z(k) - c(k) = phi_res(k-1) + S^-1 w(k)``. As c(k) depends on the
    noise up to frame k-1 only, white noise adds exactly its variance, which is subtracted.

    The controller runs over each stretch from the equilibrium for its first frames, and the first
    half second of a stretch does not count.

    Parameters
    ----------
    open_loop : (frames, n) array_like
        Recorded series z, a row per frame [nm]; what lies outside the stretches is not read.
    controller : Controller
        From y(k) to u(k).
    hardware : LoopHardware
        The loop: delay, mirror, and the sensor matrix S (square and invertible), with the sensor
        gain g that z was formed with.
    noise_nm : float or (q,) array_like
        Standard deviation of the white noise w on each measurement, per frame [nm].
    noise_error_nm : float or (q,) array_like, optional
        Standard error of that, the errors of different measurements independent [nm].
    stretches : sequence of (start, stop), optional
        Contiguous usable frames, in order; by default the whole record.
    test : sequence of (start, stop), optional
        Frames of them that count; by default all. The frames before are for the controller to
        warm up.
    from_rest : bool, optional
        Start the controller, the delay and the mirror from rest, and count all frames: the
        replay is then what such a run would have measured, frame by frame.

    Returns
    -------
    ResidualEstimate
        Measured residual, its variance without the noise, and standard errors. They include the
        sampling of Gaussian series and the error of ``noise_nm``, not that of the sensor gain.

    Raises
    ------
    ProblemError
        If a value is out of its range, sizes clash, or too few frames are left.
    UnstableLoopError
        If the loop is unstable or marginally stable.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=5.0)
    >>> ran, new = (lbt.integrator(path, gain=gain).controller for gain in (0.1, 0.5))
    >>> night = lbt.simulate(ran, truth, hardware=path, frames=8000)
    >>> y, u = night.measurements[0], night.commands[0]
    >>> z = y[2:] + u[:-2]  # a delay of two frames
    >>> would = lbt.identification.replayed_residual(z, new, path, noise_nm=5.0)
    >>> exact = lbt.residual_budget(lbt.close_loop(path, new), truth)
    >>> bool(abs(would.rms_nm - exact.rms_nm) < 3 * would.rms_error_nm)
    True
    """
    require_instance(hardware, LoopHardware)
    deviation = one_or_each(noise_nm, "noise_nm", hardware.n_measurements, at_least=0)
    series, runs = check_series(open_loop, hardware.modes, stretches)
    noise_nm2 = deviation**2 * np.eye(hardware.n_measurements)
    noise = mode_noise(hardware, noise_nm2, noise_error_nm=noise_error_nm)
    loop = close_loop(hardware, controller)
    loop.require_stable()
    tested = runs if test is None else checked_stretches(test, len(series))
    kept, replayed = settled_test(runs, tested, 0.0 if from_rest else hardware.frame_rate_hz)
    residual = replay(loop, series, replayed, from_rest=from_rest)
    return estimate_residual(gather(residual, kept), kept, *noise)


def mode_noise(
    hardware: LoopHardware,
    noise_nm2: FloatArray,
    *,
    noise_error_nm: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """Return noise (q, q) of the measurements in the modes [nm^2], and its error [nm^4], (n, n).

    The errors of the standard deviations of measurements are independent: an error of one is
    common to all modes that it measures.
    """
    back = inverse_sensor(hardware)
    error = one_or_each(noise_error_nm, "noise_error_nm", hardware.n_measurements, at_least=0)
    deviation = np.sqrt(np.diag(noise_nm2))
    # d var_i / d s_j; of white noise without correlations 2 s_j back_ij^2
    slope = 2 * back * (back @ noise_nm2) / np.where(deviation > 0, deviation, np.inf)
    return back @ noise_nm2 @ back.T, (slope * error**2) @ slope.T


def check_series(
    open_loop: ArrayLike, modes: int, stretches: StretchesLike | None, name: str = "open_loop"
) -> tuple[FloatArray, Stretches]:
    """Return a series (frames, modes) that is finite within its stretches, and the stretches."""
    series = float_array(open_loop, name)
    if series.ndim != 2 or series.shape[1] != modes or len(series) == 0:
        raise DimensionError(
            f"{name} must be (frames, {modes}), a row per frame and a column per mode; got "
            f"{series.shape}."
        )
    parts = checked_stretches(stretches, len(series))
    for start, stop in parts:
        real_array(series[start:stop], f"{name}, frames {start} to {stop},")
    return series, parts


def inverse_sensor(hardware: LoopHardware) -> FloatArray:
    """Return the inverse of the sensor matrix, (n, n)."""
    need = "a replay needs a measurement for every mode, and a sensor matrix"
    return invert(hardware.sensor, need)


def invert(square: FloatArray, need: str) -> FloatArray:
    """Return the inverse of a matrix of the loop; refuse one that has none."""
    rank = np.linalg.matrix_rank(square)
    if square.shape[0] != square.shape[1] or rank < len(square):
        raise ProblemError(f"{need} that can be inverted; got {square.shape} of rank {rank}.")
    return np.asarray(np.linalg.inv(square))


def settled_test(
    runs: Stretches, test: Stretches, frame_rate_hz: float
) -> tuple[Stretches, Stretches]:
    """Return the frames of a test that count, and those that a replay runs over before and in it.

    A replay begins where contiguous frames do, and what it has measured in their first half second
    does not count; a rate of 0 counts all. Refuse a test outside of the runs, or of few frames.
    """
    settle, kept, replayed = round(_SETTLE_S * frame_rate_hz), [], dict[int, int]()
    for start, stop in test:
        first = next((a for a, b in runs if a <= start and stop <= b), None)
        if first is None:
            raise ProblemError(
                f"the test must lie within the usable stretches; got ({start}, {stop}) in "
                f"{', '.join(map(str, runs))}."
            )
        if max(start, first + settle) < stop:
            kept.append((max(start, first + settle), stop))
            replayed[first] = stop
    frames = sum(stop - start for start, stop in kept)
    if frames < _FEWEST:
        raise ProblemError(
            f"a residual needs at least {_FEWEST} frames beyond the first {settle} of each "
            f"stretch; got {frames}. Record more, or split less."
        )
    return tuple(kept), tuple(replayed.items())


def gather(series: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the rows of a series (frames, n) that lie in some stretches."""
    return np.concatenate([series[start:stop] for start, stop in stretches])


def replay(
    loop: ClosedLoop, series: FloatArray, runs: Stretches, *, from_rest: bool = False
) -> FloatArray:
    """Return the measured residual (frames, n) of a stable loop on a series, nan outside of runs.

    z(k) stands for phi_tot(k-1), without noise: the residual of frame k-1 is e(k).
    """
    path = loop.rejection()
    constant = path.frequency_response([0.0])[0].real  # what the loop leaves of a constant
    residual = np.full(series.shape, np.nan)
    for start, stop in runs:
        mean = np.mean(series[start : min(stop, start + _FIRST)], axis=0) * (not from_rest)
        residual[start:stop] = filter_series(path, series[start:stop] - mean) + constant @ mean
    return residual


def mean_covariance(one: FloatArray, other: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the covariance over the axes of mean products of two Gaussian series, (n, n).

    Over K frames it is ``2 / K`` times the sum of the squared cross-covariances over all lags
    (M. S. Bartlett, J. Roy. Stat. Soc. Suppl. 8, 27 (1946), doi:10.2307/2983611). A periodogram I
    has ``E I^2 = 2 S^2``: no spectrum needs to be smoothed.

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
