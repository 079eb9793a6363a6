"""The classical integrator, its gain limit and its best gain (paper, III-C, erratum 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar

from lbt_synth.design.certificate import Certificate, certify_loop
from lbt_synth.design.result import UNCERTIFIED, Design, SolverReport, with_certificate
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
from lbt_synth.validation import (
    ComplexArray,
    frozen_copy,
    number,
    require_instance,
    set_fields,
)

TRIED_GAINS = 1e-4, 0.999  # range of gains that are tried, as fractions of the limit
# A line far above the bandwidth leaves one minimum with its amplification and one without: the
# trials are as close as these where the loop is fast.
_TRIALS = np.concatenate([np.geomspace(TRIED_GAINS[0], 0.1, 12), np.linspace(0.1, 0.999, 46)[1:]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntegratorDesign(Design):
    """The classical controller ``u(k) = u(k-1) + gain R y(k)``.

    Attributes
    ----------
    loop_hardware : LoopHardware
        The loop.
    gain : float
        Integrator gain, per unit of sensor gain.
    """

    controller: Controller = field(init=False)
    loop_hardware: LoopHardware
    gain: float

    def __post_init__(self) -> None:
        set_fields(self, controller=_integrator_controller(self.loop_hardware, self.gain))

    @property
    def hardware(self) -> LoopHardware | None:
        """Loop that the design is for."""
        return self.loop_hardware

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop."""
        return close_loop(self.loop_hardware, self.controller).system.poles

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices."""
        return replace(UNCERTIFIED, checks=(certify_loop(self.loop_hardware, self.controller),))


def integrator(hardware: LoopHardware, *, gain: float) -> IntegratorDesign:
    """Integrator ``u(k) = u(k-1) + gain R y(k)``.

    R is the pseudoinverse of the sensor matrix times the influence matrix.

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
    return _limit_above(hardware, 0.5 / d)  # stable: well below the limit of the next whole delay


def hardware_gain_limit(hardware: LoopHardware) -> float:
    """Gain at which an integrator loop becomes unstable, with the dynamics of the mirror."""
    if hardware.mirror is None:
        return integrator_gain_limit(hardware.delay_frames)
    single = hardware.single_mode()
    taps = single.mirror_taps
    mean_delay_frames = 1 + float(np.abs(np.arange(taps.size) @ taps))
    gain = 0.5 / mean_delay_frames
    while not close_loop(single, _integrator_controller(single, gain)).is_stable:
        gain /= 2
    return _limit_above(single, gain)


def _limit_above(hardware: LoopHardware, gain: float) -> float:
    """Return the gain limit of a loop that is stable with a given gain."""
    return gain * stable_sensor_gains(hardware, _integrator_controller(hardware, gain))[1]


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
        Certified design. The gain is within a relative 1e-6 of the best among those that are
        stable at unit sensor gain as well; ``solver.status`` says when that limit,
        not the truth, decided.

    Raises
    ------
    ProblemError
        If nothing disturbs the loop.
    CertificateError
        If the design does not pass its checks.

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
    """Refine each local minimum over a grid of gains, and design with the least."""
    limit = hardware_gain_limit(hardware) / max(1.0, sensor_gain)

    def variance(log_gain: float) -> float:
        controller = _integrator_controller(hardware, float(np.exp(log_gain)))
        try:
            loop = close_loop(hardware, controller, sensor_gain=sensor_gain)
            return budget(loop).rms_nm ** 2
        except UnstableLoopError:
            return np.inf

    trials = np.log(_TRIALS * limit)
    values = np.array([variance(trial) for trial in trials])
    walls = np.concatenate([[np.inf], values, [np.inf]])
    low = np.flatnonzero((values < walls[:-2]) & (values <= walls[2:])).tolist()
    refined = [
        minimize_scalar(
            variance,
            bounds=(float(trials[max(i - 1, 0)]), float(trials[min(i + 1, trials.size - 1)])),
            method="bounded",
            options={"xatol": 1e-7},
        )
        for i in low
    ]
    best = int(np.argmin([found.fun for found in refined]))
    limited = low[best] == trials.size - 1  # the largest gain that was tried
    status = "limited by stability at unit sensor gain" if limited else "least residual"
    return _design_with_gain(
        hardware, float(np.exp(refined[best].x)), route="search", status=status
    )


def _integrator_controller(hardware: LoopHardware, gain: float) -> Controller:
    """Return an integrator whose state x(k+1) is its command u(k)."""
    reconstructor = frozen_copy(np.linalg.pinv(hardware.sensor @ hardware.influence))
    m, q = reconstructor.shape
    return Controller(
        A=np.eye(m), B=gain * reconstructor, C=np.eye(m), D=np.zeros((m, q)), dt_s=hardware.dt_s
    )
