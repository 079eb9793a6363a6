"""The classical integrator, its gain limit and its best gain (paper, III-C, erratum 4)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar

from lbt_synth.design.result import UNCERTIFIED, IntegratorDesign, SolverReport, with_certificate
from lbt_synth.errors import ProblemError, UnstableLoopError
from lbt_synth.linear import Controller
from lbt_synth.loop import (
    ClosedLoop,
    ResidualBudget,
    close_loop,
    model_budget,
    residual_budget,
    stable_sensor_gains,
)
from lbt_synth.models import LoopHardware, TipTiltPlant, Truth
from lbt_synth.validation import frozen_copy, number, require_instance

_TRIALS = 32
TRIED_GAINS = 1e-4, 0.999  # range of gains that are tried, as parts of the limit


def integrator(hardware: LoopHardware, *, gain: float) -> IntegratorDesign:
    """Integrator ``u(k) = u(k-1) + gain R y(k)``, R the generalised inverse of D N.

    Parameters
    ----------
    hardware : LoopHardware
        The loop.
    gain : float
        Gain, above 0 and below :func:`integrator_gain_limit`.

    Returns
    -------
    IntegratorDesign
        Certified design.

    Raises
    ------
    ProblemError
        If the gain is not a positive number.
    CertificateError
        If the loop is not stable at unit sensor gain.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> bool(max(abs(lbt.integrator(path, gain=0.25).poles)) < 1)
    True
    """
    return _design_with_gain(
        hardware, number(gain, "gain", above=0), route="closed form", status="given"
    )


def _design_with_gain(
    hardware: LoopHardware, gain: float, *, route: str, status: str
) -> IntegratorDesign:
    """Make the design of a gain and certify it."""
    design = IntegratorDesign(
        method="integrator",
        controller=_integrator_controller(hardware, gain),
        certificate=UNCERTIFIED,
        solver=SolverReport(route=route, status=status, iterations=0),
        loop_hardware=hardware,
        gain=gain,
    )
    return with_certificate(design, f"Lower the gain {gain:.6g}.")


def integrator_gain_limit(delay_frames: float) -> float:
    """Gain at which an integrator loop becomes unstable.

    ``2 sin(pi / (2 (2 d - 1)))`` for a whole delay of d frames; for a fractional
    one the limit is found numerically.

    Parameters
    ----------
    delay_frames : float
        Total delay [frames], at least 1.

    Returns
    -------
    float
        The limit.

    Raises
    ------
    ProblemError
        If the delay is below 1 or not a number.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> [round(lbt.design.integrator_gain_limit(d), 3) for d in (2, 3, 4)]
    [1.0, 0.618, 0.445]
    """
    hardware = LoopHardware(frame_rate_hz=1.0, delay_frames=delay_frames, modes=1)
    d = hardware.delay_frames
    if d == round(d):
        return float(2 * np.sin(np.pi / (2 * (2 * d - 1))))
    start = 0.5 / d  # stable: well below the limit of the next whole delay
    return start * stable_sensor_gains(hardware, _integrator_controller(hardware, start))[1]


def hardware_gain_limit(hardware: LoopHardware) -> float:
    """Gain at which an integrator becomes unstable, with the dynamics of the mirror."""
    if hardware.mirror is None:
        return integrator_gain_limit(hardware.delay_frames)
    single = hardware.single_mode()
    taps = single.mirror_taps
    start = 0.5 / (1 + float(np.abs(np.arange(taps.size) @ taps)))  # half over the mean delay
    while not close_loop(single, _integrator_controller(single, start)).is_stable:
        start /= 2
    return start * stable_sensor_gains(single, _integrator_controller(single, start))[1]


def optimal_integrator(hardware: LoopHardware, truth: Truth) -> IntegratorDesign:
    """Integrator whose gain leaves the least residual for a given truth.

    Parameters
    ----------
    hardware : LoopHardware
        The loop.
    truth : Truth
        Disturbances, noise and sensor gain.

    Returns
    -------
    IntegratorDesign
        Certified design. The gain is within 1e-6 of the best among those that are
        stable at unit sensor gain as well; ``solver.status`` says when that limit,
        not the truth, decided.

    Raises
    ------
    ProblemError
        If nothing disturbs the loop.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> slow = lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> design = lbt.design.optimal_integrator(path, lbt.Truth(turbulence=slow, noise_nm=20.0))
    >>> 0.2 < design.gain < 0.6
    True
    """
    turbulence = truth.turbulence_groups(hardware.modes)
    if not turbulence and not truth.vibrations and not np.any(truth.noise_nm):
        raise ProblemError(
            "the truth must disturb the loop; got no turbulence, vibration or noise."
        )
    return _least_residual(hardware, lambda loop: residual_budget(loop, truth), truth.sensor_gain)


def model_integrator(plant: TipTiltPlant) -> IntegratorDesign:
    """Integrator whose gain leaves the least residual where a plant's model is the truth.

    Parameters
    ----------
    plant : TipTiltPlant
        Turbulence of each mode, vibrations, noise and loop.

    Returns
    -------
    IntegratorDesign
        Certified design, as that of :func:`optimal_integrator`.

    Raises
    ------
    CertificateError
        If the design does not pass its checks.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.999], driving_rms_nm=10.0, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=20.0)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=20.0)
    >>> same = lbt.design.optimal_integrator(plant.hardware, truth)
    >>> bool(abs(lbt.design.model_integrator(plant).gain / same.gain - 1) < 1e-6)
    True
    """
    require_instance(plant, TipTiltPlant)
    return _least_residual(plant.hardware, lambda loop: model_budget(loop, plant), 1.0)


def _least_residual(
    hardware: LoopHardware, budget: Callable[[ClosedLoop], ResidualBudget], sensor_gain: float
) -> IntegratorDesign:
    """Return the design of least residual: trials on a grid of gains, the best of them refined."""
    limit = hardware_gain_limit(hardware) / max(1.0, sensor_gain)

    def variance(log_gain: float) -> float:
        controller = _integrator_controller(hardware, float(np.exp(log_gain)))
        try:
            loop = close_loop(hardware, controller, sensor_gain=sensor_gain)
            return budget(loop).rms_nm ** 2
        except UnstableLoopError:
            return np.inf

    trials = np.log(np.geomspace(*TRIED_GAINS, _TRIALS) * limit)
    values = [variance(trial) for trial in trials]
    best = int(np.argmin(values))
    bracket = trials[max(best - 1, 0)], trials[min(best + 1, _TRIALS - 1)]
    found = minimize_scalar(variance, bounds=bracket, method="bounded", options={"xatol": 1e-7})
    limited = best == _TRIALS - 1
    status = "limited by stability at unit sensor gain" if limited else "least residual"
    return _design_with_gain(hardware, float(np.exp(found.x)), route="search", status=status)


def _integrator_controller(hardware: LoopHardware, gain: float) -> Controller:
    reconstructor = frozen_copy(np.linalg.pinv(hardware.sensor @ hardware.influence))
    m, q = reconstructor.shape
    return Controller(
        A=np.eye(m), B=gain * reconstructor, C=np.eye(m), D=np.zeros((m, q)), dt_s=hardware.dt_s
    )
