"""The residual that a controller would have left of a recorded disturbance.

Loops replayed on recorded series: where they start, and what the start may still add.

The state of a loop at the beginning of contiguous frames depends on the frames before, which are
not known. A replay begins in the equilibrium for the mean of the first frames. An error d of that
state adds ``C A^k d`` to the residual of frame k. Its covariance P is that of the loop's state
under the record's own sample autocovariance: with s(k) the state on the N frames, less that
mean, from rest, and then on zeros for ever,

    P = (1 / N) sum over all k of s(k) s(k)'

From frame a to frame b the start then adds ``(1 / (b - a)) sum C A^k P A'^k C'`` to the mean
square. A loop warms up on the frames before the test, and on as many of its first frames as make
the error of the residual least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import rfft

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.stretches import Stretches, StretchesLike, checked_stretches
from lbt_synth.linear import Controller
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.loop import ClosedLoop, Imaging, close_loop, jitter_strehl
from lbt_synth.models import LoopHardware
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    float_array,
    frozen_copy,
    number,
    one_or_each,
    real_array,
    require_instance,
)

_TOO_FAR = 4.0  # standard errors below zero that chance does not explain
FEWEST = 100  # frames that give a standard error
_FIRST = 64  # frames whose mean a replay begins with
_MOST_STATES = 1 << 15  # frames of a stretch that show the spread of the state
_TINY = 1e-300


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
    def measured_nm2(self) -> float:
        """Mean square of the measured residual over all axes, noise included [nm^2]."""
        return self.total_nm2 + float(np.trace(self.noise_nm2))

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


def estimate_replay(
    run: Replay, test: Stretches, noise: tuple[FloatArray, FloatArray]
) -> ResidualEstimate:
    """Return the residual of a replay in the frames that count, under the :func:`mode_noise`."""
    return estimate_residual(run.measured(test), test, *noise, run.left_of_start(test))


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
    gain = number(sensor_gain, "sensor_gain", above=0)
    series, runs = check_series(open_loop, hardware.modes, stretches)
    noise_nm2 = deviation**2 * np.eye(hardware.n_measurements)
    noise = mode_noise(hardware, noise_nm2, noise_error_nm=noise_error_nm, sensor_gain=gain)
    loop = close_loop(hardware, controller, sensor_gain=gain)
    loop.require_stable()
    tested = runs if test is None else checked_stretches(test, len(series))
    check_test(runs, tested)
    run = replay(loop, series, runs, from_rest=from_rest)
    warm_up = 0 if from_rest else choose_warm_up([run], tested)
    return estimate_replay(run, leave_out(runs, tested, warm_up), noise)


def mode_noise(
    hardware: LoopHardware,
    noise_nm2: FloatArray,
    *,
    noise_error_nm: ArrayLike,
    sensor_gain: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Return noise (q, q) of the measurements in the modes [nm^2], and its error [nm^4], (n, n).

    The errors of the standard deviations of measurements are independent: an error of one is
    common to all modes that it measures.
    """
    back = inverse_sensor(hardware) / sensor_gain
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


def check_test(runs: Stretches, test: Stretches) -> None:
    """Refuse a test that does not lie in contiguous frames, or has too few."""
    for start, stop in test:
        if not any(a <= start and stop <= b for a, b in runs):
            raise ProblemError(
                f"the test must lie within the usable stretches; got ({start}, {stop}) in "
                f"{', '.join(map(str, runs))}."
            )
    if count_frames(test) < FEWEST:
        raise ProblemError(
            f"a residual needs at least {FEWEST} frames; got {count_frames(test)}. Record more."
        )


def count_frames(test: Stretches) -> int:
    """Return the number of frames of stretches."""
    return sum(stop - start for start, stop in test)


def leave_out(runs: Stretches, test: Stretches, frames: int) -> Stretches:
    """Return a test without the first frames of each run."""
    kept = [(max(start, _run_start(runs, start) + frames), stop) for start, stop in test]
    return tuple((a, b) for a, b in kept if a < b)


def _run_start(runs: Stretches, frame: int) -> int:
    """Return where the run of a frame begins."""
    return max(a for a, _ in runs if a <= frame)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Replay:
    """What a loop leaves of recorded frames, and what the error of its start adds.

    A loop without states that are unknown, such as one that was measured, has no ``spread``.
    """

    runs: Stretches  # contiguous frames
    residual: FloatArray  # (frames, n): the measured residual; nan outside the runs
    output: FloatArray  # (n, s): C
    powers: tuple[FloatArray, ...] = ()  # (s, s) each: A, A^2, A^4, ...
    spread: FloatArray | None = None  # (s, s): sum of A^k P A'^k over all k

    def measured(self, test: Stretches) -> FloatArray:
        """Return the measured residual of the frames that count, (k, n)."""
        return np.concatenate([self.residual[start:stop] for start, stop in test])

    def scatter(self, test: Stretches) -> float:
        """Return the standard error of the mean square over all axes, but for the start."""
        e = self.measured(test)
        return float(np.sqrt(max(np.sum(mean_covariance(e, e, test)), 0.0)))

    def left_of_start(self, test: Stretches) -> FloatArray:
        """Return the mean square that the start adds to the test, (n, n)."""
        n = len(self.output)
        total = np.zeros((n, n))
        for start, stop in test:
            first = _run_start(self.runs, start)
            total += self._energy_after(start - first) - self._energy_after(stop - first)
        return total / count_frames(test)

    def _energy_after(self, frames: int) -> FloatArray:
        """Return the sum of the squares that the start adds from a frame on, (n, n)."""
        row = self.output
        for i, power in enumerate(self.powers):
            if frames >> i & 1:
                row = row @ power
        return row @ self.spread @ row.T if self.spread is not None else 0 * row @ row.T


def replay(loop: ClosedLoop, series: FloatArray, runs: Stretches, *, from_rest: bool) -> Replay:
    """Replay a stable loop on a recorded series (frames, n)."""
    # z(k) for phi_tot(k-1), and no noise: the residual of frame k-1 is e(k)
    path = loop.rejection()
    s, n = path.B.shape
    equilibrium = np.linalg.solve(np.eye(s) - path.A, path.B)
    constant = path.C @ equilibrium + path.D  # what the loop leaves of a constant
    both = replace(path, C=np.vstack([path.C, np.eye(s)]), D=np.vstack([path.D, np.zeros((s, n))]))
    residual = np.full(series.shape, np.nan)
    moments, count = np.zeros((s, s)), 0
    for start, stop in runs:
        mean = np.zeros(n) if from_rest else np.mean(series[start : min(stop, start + _FIRST)], 0)
        away = series[start:stop] - mean
        residual[start:stop] = filter_series(path, away) + constant @ mean
        if not from_rest:
            away = away[:_MOST_STATES]
            states = filter_series(both, away)[:, n:]
            last = path.A @ states[-1] + path.B @ away[-1]
            moments += states.T @ states
            moments += stationary_covariance(path.A, np.outer(last, last))
            count += len(away)
    if from_rest:
        return Replay(runs=runs, residual=residual, output=path.C)
    powers = [path.A]
    for _ in range(len(series).bit_length()):
        powers.append(powers[-1] @ powers[-1])
    return Replay(
        runs=runs,
        residual=residual,
        output=path.C,
        powers=tuple(powers),
        spread=stationary_covariance(path.A, moments / count),
    )


def choose_warm_up(replays: Sequence[Replay], test: Stretches) -> int:
    """Return the frames at the beginning of each run that are better left out.

    It is the number for which the variances of the mean squares, by the scatter of the residual
    and by its start, have the least sum over the replays, in units of the first.
    """
    runs = replays[0].runs
    longest = max(stop - start for start, stop in runs)
    tried = [0, *np.unique(np.geomspace(1, longest, 60).astype(int)).tolist()]
    parts = [(w, leave_out(runs, test, w)) for w in tried]
    kept = [(w, part) for w, part in parts if count_frames(part) >= FEWEST]
    adds = np.array([[np.trace(one.left_of_start(part)) for one in replays] for _, part in kept])
    share = np.array([count_frames(test) / count_frames(part) for _, part in kept])
    best = 0
    for _ in range(2):  # the first scatter has the start in it
        scatter = np.array([one.scatter(kept[best][1]) for one in replays])
        scatter /= np.sqrt(share[best])
        variances = len(replays) * share + np.sum((adds / np.maximum(scatter, _TINY)) ** 2, axis=1)
        best = int(np.argmin(variances))
    return int(kept[best][0])


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
