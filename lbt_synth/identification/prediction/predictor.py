"""The best FIR predictor of a record by least squares, without a model of the disturbance.

With the mirror's taps c, the filtered series ``zf(k) = c[0] z(k) + c[1] z(k-1) + ...`` and
commands ``u(k) = a[0] z(k) + a[1] z(k-1) + ...``, the measured residual is ``e(k) = z(k) -
a[0] zf(k-1) - a[1] zf(k-2) - ...``: a linear regression whose sum of squares is the one that a
replay measures, for fractional delays and mirrors that move as well.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.identification.prediction.residual import check_series, inverse_sensor, invert
from lbt_synth.identification.stretches import StretchesLike
from lbt_synth.linear import Controller
from lbt_synth.loop import youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import (
    FloatArray,
    frozen_copy,
    integer,
    require_instance,
)

_MOST_TAPS = 1000
_LEAST_ROWS = 4  # frames per coefficient


def least_squares_predictor(
    open_loop: ArrayLike,
    hardware: LoopHardware,
    *,
    taps: int = 32,
    stretches: StretchesLike | None = None,
) -> tuple[Controller, FloatArray]:
    """Fit the FIR predictor of least residual of each mode to a record, and make it a controller.

    Parameters
    ----------
    open_loop : (frames, n) array_like
        Recorded pseudo-open-loop series ``z(k) = phi_tot(k-1) + S^-1 w(k)`` [nm].
    hardware : LoopHardware
        The loop: delay, mirror, sensor and influence matrix, both square and invertible. The sensor
        matrix has the sensor gain that z was formed with.
    taps : int, optional
        Coefficients per mode, at most 1000.
    stretches : sequence of (start, stop), optional
        Contiguous usable frames to fit; by default the whole record.

    Returns
    -------
    controller : Controller
        From y(k) to u(k). The filter is its Youla parameter (:func:`youla_controller`): the loop
        is stable for any coefficients, at the sensor gain of the fit.
    coefficients : (n, taps) ndarray
        What z_i(k-l) adds to the correction of mode i that u(k) commands. Regressors that depend
        on each other get the coefficients of least norm.

    Raises
    ------
    ProblemError
        If a value is out of range, sizes clash, or there are fewer than four frames per
        coefficient.

    Examples
    --------
    Two frames ahead, an AR1 process without noise is predicted by the square of its pole:

    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.9], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> idle = lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0, dt_s=1 / 800)
    >>> run = lbt.simulate(idle, lbt.Truth(turbulence=slow), hardware=path, frames=20_000)
    >>> _, taps = lbt.identification.least_squares_predictor(run.total_nm[0], path, taps=1)
    >>> bool(abs(taps[0, 0] - 0.81) < 0.02)
    True
    """
    require_instance(hardware, LoopHardware)
    count = integer(taps, "taps", at_least=1, at_most=_MOST_TAPS)
    back, n = inverse_sensor(hardware), hardware.modes
    need = "a predictor needs a command for every mode, and an influence matrix"
    to_command = invert(hardware.influence, need)
    series, parts = check_series(open_loop, n, stretches)
    blocks = [_regression(series[a:b], hardware.mirror_taps, count) for a, b in parts]
    X, Z = (np.concatenate(block) for block in zip(*blocks, strict=True))
    if len(X) < _LEAST_ROWS * count:
        raise ProblemError(
            f"a predictor of {count} coefficients needs at least {_LEAST_ROWS * count} frames to "
            f"fit, beside {count} and the mirror's at the beginning of each stretch; got "
            f"{len(X)}. Record more, or lower taps."
        )
    tolerance = np.finfo(float).eps * (count + 1)
    fits = [np.linalg.lstsq(X[:, i], Z[:, i], rcond=tolerance)[0] for i in range(n)]
    coefficients = np.array(fits)
    # an FIR filter of z from y to u, whose states are the last z
    parameter = Controller(
        A=np.eye(n * count, k=-n),
        B=np.vstack([back, np.zeros((n * (count - 1), n))]),
        C=to_command @ np.hstack([np.diag(column) for column in coefficients.T]),
        D=np.zeros((n, n)),
        dt_s=hardware.dt_s,
    )
    return youla_controller(hardware, parameter), frozen_copy(coefficients)


def _regression(
    part: FloatArray, mirror_taps: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return regressors ``zf(k-1), zf(k-2), ...`` (rows, n, taps) and targets z(k) (rows, n)."""
    frames, n = part.shape
    m = len(mirror_taps)
    rows = frames - (m - 1) - count  # the first needs zf(k-taps), which needs m values of z
    if rows < 1:
        return np.zeros((0, n, count)), np.zeros((0, n))
    filtered = sliding_window_view(part, m, axis=0) @ mirror_taps[::-1]
    late = sliding_window_view(filtered, count, axis=0)[:rows, :, ::-1]
    return np.asarray(late), part[m - 1 + count :]
