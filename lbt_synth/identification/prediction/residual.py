"""The residual that a controller would have left of a recorded disturbance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.prediction.replay import (
    Replay,
    ReplayFrames,
    choose_warm_up,
    mean_covariance,
    replay,
    replay_frames,
)
from lbt_synth.identification.stretches import Stretches, StretchesLike, checked_stretches
from lbt_synth.linear import Controller
from lbt_synth.loop import Imaging, close_loop, jitter_strehl
from lbt_synth.models import LoopHardware
from lbt_synth.validation import (
    FloatArray,
    float_array,
    frozen_copy,
    number,
    one_or_each,
    real_array,
    require_instance,
)

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
    start_nm2 : (n, n) ndarray
        Mean square that the unknown state of the loop before the record may add [nm^2].
    error_nm4 : (n, n) ndarray
        Covariance of the errors of the axes' variances, that of the start included [nm^4].
    """

    measured_nm: FloatArray
    stretches: Stretches
    noise_nm2: FloatArray
    covariance_nm2: FloatArray
    start_nm2: FloatArray
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
        variance = self.variance_nm2
        return frozen_copy(np.sqrt(np.where(variance >= 0, variance, np.nan)))

    @property
    def axis_rms_error_nm(self) -> FloatArray:
        """Standard error of each axis' rms, (n,) [nm]; nan where the variance is negative."""
        with np.errstate(divide="ignore"):
            return frozen_copy(self.variance_error_nm2 / (2 * self.axis_rms_nm))

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

    def strehl(self, imaging: Imaging) -> float:
        """Long-exposure Strehl ratio of a Gaussian residual of this covariance, in [0, 1].

        It is nan if the covariance is not positive semidefinite: the residual is lost in the noise.
        """
        if np.linalg.eigvalsh(self.covariance_nm2)[0] < 0:
            return float("nan")
        return jitter_strehl(self.covariance_nm2, imaging=imaging)


def estimate_residual(
    measured: FloatArray,
    stretches: Stretches,
    noise_nm2: FloatArray,
    noise_error_nm4: FloatArray,
    start_nm2: FloatArray | None = None,
) -> ResidualEstimate:
    """Estimate a residual from the measured residual (frames, n) of some stretches."""
    start = np.zeros_like(noise_nm2) if start_nm2 is None else start_nm2
    error = mean_covariance(measured, measured, stretches) + noise_error_nm4
    return ResidualEstimate(
        measured_nm=frozen_copy(measured),
        stretches=stretches,
        noise_nm2=frozen_copy(noise_nm2),
        covariance_nm2=frozen_copy(measured.T @ measured / len(measured) - noise_nm2),
        start_nm2=frozen_copy(start),
        error_nm4=frozen_copy(error + np.outer(np.diag(start), np.diag(start))),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictionData:
    """A recorded pseudo-open-loop series that fits a loop, and what is known of its noise."""

    open_loop: FloatArray  # (frames, n): the series z(k) [nm], finite in the stretches
    stretches: Stretches  # contiguous frames that can be used
    noise_nm2: FloatArray  # (n, n): covariance of the noise in z
    noise_error_nm4: FloatArray  # (n, n): covariance of the errors of the noise variances

    def estimate(self, run: Replay, frames: ReplayFrames) -> ResidualEstimate:
        """Return the residual of a replay in the frames that count."""
        return estimate_residual(
            run.measured(frames),
            frames.test,
            self.noise_nm2,
            self.noise_error_nm4,
            run.left_of_start(frames),
        )


def replayed_residual(
    open_loop: ArrayLike,
    controller: Controller,
    hardware: LoopHardware,
    *,
    noise_nm: ArrayLike,
    noise_error_nm: ArrayLike = 0.0,
    sensor_gain: float = 1.0,
    stretches: StretchesLike | None = None,
    test: StretchesLike | None = None,
    from_rest: bool = False,
) -> ResidualEstimate:
    """Residual that a controller would have left of a recorded disturbance.

    The pseudo-open-loop measurement ``z(k) = phi_tot(k-1) + w(k) / g`` does not depend on the
    controller that ran. From ``y(k) = g S (z(k) - c(k))``, with c(k) its own correction, a
    controller computes exactly the commands of that loop under that disturbance and noise. Its
    measured residual is ``e(k) = z(k) - c(k) = phi_res(k-1) + w(k) / g``. As c(k) depends on the
    noise up to frame k-1 only, white noise adds exactly its variance, which is subtracted.

    The controller runs over each stretch from the equilibrium for its first frames. What the
    error of that start can add to the mean square is part of the standard error, and as many
    frames at the beginning of each stretch are left out of the test as make the whole error least.

    Parameters
    ----------
    open_loop : (frames, n) array_like
        Recorded series z, a row per frame [nm]; what lies outside the stretches is not read.
    controller : Controller
        From y(k) to u(k).
    hardware : LoopHardware
        The loop: delay, mirror, sensor matrix S (square and invertible).
    noise_nm : float or (q,) array_like
        Standard deviation of the white noise w on each measurement, per frame [nm].
    noise_error_nm : float or (q,) array_like, optional
        Standard error of that, the errors of different measurements independent [nm].
    sensor_gain : float, optional
        Sensor gain g of the recorded loop relative to the sensor matrix, as used to form z.
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
        sampling of Gaussian series, the start and the error of ``noise_nm``, not that of the
        sensor gain.

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
    data = prediction_data(
        open_loop,
        hardware,
        deviation**2 * np.eye(hardware.n_measurements),
        noise_error_nm=noise_error_nm,
        sensor_gain=sensor_gain,
        stretches=stretches,
    )
    loop = close_loop(hardware, controller, sensor_gain=sensor_gain)
    loop.require_stable()
    runs = data.stretches
    tested = runs if test is None else checked_stretches(test, len(data.open_loop))
    frames = replay_frames(runs, tested)
    run = replay(loop, data.open_loop, runs, from_rest=from_rest)
    warm_up = 0 if from_rest else choose_warm_up([run], frames)
    return data.estimate(run, frames.without(warm_up))


def prediction_data(
    open_loop: ArrayLike,
    hardware: LoopHardware,
    noise_nm2: FloatArray,
    *,
    noise_error_nm: ArrayLike,
    sensor_gain: float = 1.0,
    stretches: StretchesLike | None,
) -> PredictionData:
    """Check a recorded series against a loop, and refer the noise (q, q) to the modes.

    The errors of the standard deviations of measurements are independent: an error of one is
    common to all modes that it measures.
    """
    gain = number(sensor_gain, "sensor_gain", above=0)
    series, parts = check_series(open_loop, hardware.modes, stretches)
    back = inverse_sensor(hardware) / gain
    q = hardware.n_measurements
    error = one_or_each(noise_error_nm, "noise_error_nm", q, at_least=0)
    deviation = np.sqrt(np.diag(noise_nm2))
    # d var_i / d s_j; of white noise without correlations 2 s_j back_ij^2
    slope = 2 * back * (back @ noise_nm2) / np.where(deviation > 0, deviation, np.inf)
    return PredictionData(
        open_loop=series,
        stretches=parts,
        noise_nm2=back @ noise_nm2 @ back.T,
        noise_error_nm4=(slope * error**2) @ slope.T,
    )


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
