"""The controller of a given order that leaves least of a measured spectrum, without a model.

With a stable filter Q from the pseudo-open-loop series to the command, a loop leaves ``e = (1 -
z^-1 M Q) z`` of the series, M the mirror's delay. The mean square of e over the periodogram of z
is a sum of squares that is linear in Q: for given poles a least-squares problem, and the poles
follow by variable projection (G. H. Golub, V. Pereyra, SIAM J. Numer. Anal. 10, 413 (1973),
doi:10.1137/0710036). That such a loop is convex in the measured spectrum is the idea of I. Dinis
et al. (arXiv:2410.05123), who bound its norms as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, eigh, solve_discrete_lyapunov

from lbt_synth.design.shaping.channel import Channel, laguerre_basis, orthonormal_basis
from lbt_synth.design.shaping.reduction import WeightedResponse, fit_poles, starting_poles
from lbt_synth.identification.fit.periodogram import loop_periodogram
from lbt_synth.identification.prediction.residual import check_series, inverse_sensor, invert
from lbt_synth.identification.stretches import Stretches, StretchesLike
from lbt_synth.linear import Controller
from lbt_synth.loop import youla_controller
from lbt_synth.models import LoopHardware
from lbt_synth.validation import ComplexArray, FloatArray, integer, number, require_instance

_MOST_ORDER = 40
_MOST_FREQUENCIES = 2048
_LONG, _LONG_POLE = 80, 0.7  # Laguerre functions of the filter whose poles are tried first
_SLOW = 1e-3  # angle per frame of the slowest poles that are tried


def spectral_design(
    open_loop: ArrayLike,
    hardware: LoopHardware,
    *,
    order: int = 10,
    sensor_gain: float = 1.0,
    stretches: StretchesLike | None = None,
) -> Controller:
    """Return the controller whose filter of a given order leaves least of a measured spectrum.

    Parameters
    ----------
    open_loop, hardware, sensor_gain, stretches
        As for :func:`least_squares_predictor`; the spectrum is that of the stretches.
    order : int, optional
        Poles of the filter of each mode, from 2 to 40; the states of delay and mirror come on top.

    Returns
    -------
    Controller
        From y(k) to u(k), stable in the loop for the sensor gain of the series.

    Raises
    ------
    ProblemError
        If a value is out of range, or sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=5.0)
    >>> idle = lbt.Controller(A=0.0, B=0.0, C=0.0, D=0.0, dt_s=1 / 800)
    >>> run = lbt.simulate(idle, truth, hardware=path, frames=20_000)
    >>> found = lbt.identification.spectral_design(run.measurements[0], path, order=4)
    >>> left_nm = lbt.residual_budget(lbt.close_loop(path, found), truth).rms_nm
    >>> bool(left_nm < 1.01 * lbt.loop.least_residual(path, truth).rms_nm)
    True
    """
    require_instance(hardware, LoopHardware)
    count = integer(order, "order", at_least=2, at_most=_MOST_ORDER)
    gain = number(sensor_gain, "sensor_gain", above=0)
    back = inverse_sensor(hardware) / gain
    need = "a predictor needs a command for every mode, and an influence matrix"
    to_command = invert(hardware.influence, need)
    series, parts = check_series(open_loop, hardware.modes, stretches)
    filters = [_filter_for_axis(column, parts, hardware, count) for column in series.T]
    A, B, C = (block_diag(*(getattr(each, name) for each in filters)) for name in "ABC")
    parameter = Controller(
        A=A, B=B @ back, C=to_command @ C, D=np.zeros(back.shape), dt_s=hardware.dt_s
    )
    believed = replace(hardware, sensor_matrix=gain * hardware.sensor)
    return youla_controller(believed, parameter)


def _filter_for_axis(
    series: FloatArray, stretches: Stretches, hardware: LoopHardware, order: int
) -> Controller:
    """Return the filter from one series (frames,) to its command."""
    rate, single = hardware.frame_rate_hz, hardware.single_mode()
    found = loop_periodogram(series, None, frame_rate_hz=rate, stretches=stretches)
    together = -(-len(found.frequency_hz) // _MOST_FREQUENCIES)
    smooth = found.merge(np.arange(0, len(found.frequency_hz), together))
    mean = float(np.mean(np.concatenate([series[start:stop] for start, stop in stretches])))
    f = np.append(0.0, smooth.frequency_hz)
    power = np.append(mean**2, smooth.measured * smooth.step_hz)
    size = np.sqrt(power / np.sum(power))
    z = np.exp(2j * np.pi * f * hardware.dt_s)
    path: ComplexArray = Channel(
        hardware=single, basis=laguerre_basis(1, 0.0, dt_s=hardware.dt_s)
    ).complementary_rows(f)[:, 0]
    weight = size * np.abs(path)
    # |size (1 - path Q)| = |weight / path - weight Q|: Q is fitted to the inverse of the path
    target = size * np.exp(-1j * np.angle(path))
    response = WeightedResponse(z, target, weight)
    long = laguerre_basis(_LONG, _LONG_POLE, dt_s=hardware.dt_s)
    coefficients = response.coefficients(long.response(f))
    starts = [
        _dominant_poles(long.A, coefficients, order),
        starting_poles(order, bands=np.zeros((0, 2)), noise_rad=_SLOW),
    ]
    poles = min((fit_poles(response, start) for start in starts), key=lambda fit: fit[1])[0]
    basis = orthonormal_basis(poles, dt_s=hardware.dt_s)
    return basis.parameter(response.coefficients(basis.response(f)))


def _dominant_poles(A: FloatArray, coefficients: FloatArray, order: int) -> ComplexArray:
    """Return the poles of a balanced truncation of a filter in an orthonormal basis.

    The states of the basis are balanced inputs already (``A A' + B B' = I``): those kept are the
    main axes of what the output shows of them.
    """
    seen = solve_discrete_lyapunov(A.T, np.outer(coefficients, coefficients))
    _, axes = eigh(seen)
    kept = axes[:, -order:]
    return np.asarray(np.linalg.eigvals(kept.T @ A @ kept), dtype=np.complex128)
