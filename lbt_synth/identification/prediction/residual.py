"""The residual that a controller would have left of a recorded disturbance."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.identification.prediction.residual_estimate import (
    ResidualEstimate,
    estimate_residual,
)
from lbt_synth.identification.stretches import Stretches, StretchesLike, checked_stretches
from lbt_synth.linear import Controller
from lbt_synth.loop import ClosedLoop, close_loop, filter_series
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.models import LoopHardware
from lbt_synth.validation import (
    FloatArray,
    float_array,
    integer,
    number,
    one_or_each,
    real_array,
    require_instance,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictionData:
    """A recorded pseudo-open-loop series that fits a loop, and what is known of its noise."""

    open_loop: FloatArray  # (frames, n): the series z(k) [nm], finite in the stretches
    stretches: Stretches  # frames that can be used
    noise_nm2: FloatArray  # (n, n): covariance of the noise in z
    noise_error_nm4: FloatArray  # (n, n): covariance of the errors of the noise variances

    def estimate(self, measure: Callable[[int, int], FloatArray], settle: int) -> ResidualEstimate:
        """Return the residual of a loop that settles, given what it leaves of some frames."""
        kept = drop_settling(self.stretches, settle)
        measured = np.concatenate([measure(start, stop) for start, stop in kept])
        return estimate_residual(measured, kept, self.noise_nm2, self.noise_error_nm4)


def replayed_residual(
    open_loop: ArrayLike,
    controller: Controller,
    hardware: LoopHardware,
    *,
    noise_nm: ArrayLike,
    noise_error_nm: ArrayLike = 0.0,
    sensor_gain: float = 1.0,
    stretches: StretchesLike | None = None,
    settle_frames: int | None = None,
) -> ResidualEstimate:
    """Residual that a controller would have left of a recorded disturbance.

    The pseudo-open-loop measurement ``z(k) = phi_tot(k-1) + w(k) / g`` does not depend on the
    controller that ran. From ``y(k) = g S (z(k) - c(k))``, with c(k) its own correction, a
    controller computes exactly the commands of that loop under that disturbance and noise. Its
    measured residual is ``e(k) = z(k) - c(k) = phi_res(k-1) + w(k) / g``. As c(k) depends on the
    noise up to frame k-1 only, white noise adds exactly its variance, which is subtracted.

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
    settle_frames : int, optional
        Frames dropped at the beginning of each stretch, where the controller starts from zero; by
        default until the slowest mode of the loop has decayed to 1e-4, and at least as many as
        the loop has states. Shorter stretches are left out.

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
    return predict_residual(data, loop, choose_settling(settle_frames, [loop]))


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
        if not np.all(np.isfinite(series[start:stop])):
            real_array(series[start:stop], f"{name}, frames {start} to {stop},")  # says where
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


def choose_settling(given: int | None, loops: Iterable[ClosedLoop]) -> int:
    """Return the given frames, or those after which the slowest loop has forgotten its start."""
    if given is not None:
        return integer(given, "settle_frames", at_least=0)
    return max(max(settling_frames(loop.spectral_radius), loop.system.n_states) for loop in loops)


def predict_residual(data: PredictionData, loop: ClosedLoop, settle: int) -> ResidualEstimate:
    """Return the residual of a stable loop replayed on recorded data."""
    # z(k) for phi_tot(k-1), and no noise: the residual of frame k-1 is e(k)
    path, z = loop.rejection(), data.open_loop
    return data.estimate(lambda a, b: filter_series(path, z[a - settle : b])[settle:], settle)


def drop_settling(stretches: Stretches, settle: int) -> Stretches:
    """Return the stretches without the frames in which a loop settles."""
    kept = tuple((start + settle, stop) for start, stop in stretches if stop - start > settle)
    if not kept:
        longest = max(stop - start for start, stop in stretches)
        raise ProblemError(
            f"a stretch must be longer than the {settle} frames in which the loop settles; the "
            f"longest has {longest}. Give a longer record, or lower settle_frames."
        )
    return kept
