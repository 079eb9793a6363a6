"""LQG: the Kalman filter, and the commands that bring a mirror with dynamics to its estimate.

The disturbance is estimated from the pseudo-open-loop measurement, which the commands do not
touch; a linear-quadratic regulator on [disturbance; mirror] chooses the commands. The mirror
is the same for all commands, so that the regulator is one scalar Riccati problem of the
mirror's few states and one linear equation for the disturbance (C. Correia, H.-F. Raynaud,
C. Kulcsar, J.-M. Conan, J. Opt. Soc. Am. A 27, 333 (2010), doi:10.1364/JOSAA.27.000333).

With the mirror's core ``m(k+1) = F m(k) + G v(k)``, ``c(k) = h m(k) + d v(k)``, one frame of
one mode, ``v = (N u)_i`` and the target ``z(k) = l x(k+1)``, which is phi_tot(k + lead)::

    minimise  E (z(k) - c(k))^2 + rho v(k)^2
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lbt_synth.design.lqg_design import LqgDesign, estimation_plant, lqg_controller
from lbt_synth.design.result import UNCERTIFIED, SolverReport, with_certificate
from lbt_synth.errors import DimensionError, InfeasibleError, ProblemError
from lbt_synth.linear import solve_dare
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.validation import FloatArray, frozen_copy, number

_ON_CIRCLE = 1e-6  # a zero this close to the unit circle leaves no stable regulator
_SQUARINGS = 60


class Regulator(NamedTuple):
    """Commands ``N u = gain_state x - gain_mirror m``, with the Riccati solution behind them.

    ``weight`` is ``d^2 + rho + G'XG``; ``status`` and ``iterations`` are those of the equation.
    """

    gain_state: FloatArray
    gain_mirror: FloatArray
    weight: float
    status: str
    iterations: int


def lqg(plant: TipTiltPlant, *, command_weight: float = 0.0) -> LqgDesign:
    """Design the controller of least residual for a mirror that moves, or a fractional delay.

    For a mirror that settles at once and a whole delay it is the Kalman controller.

    Parameters
    ----------
    plant : TipTiltPlant
        Disturbance, noise and loop; the dynamics are those of ``plant.hardware.mirror``.
    command_weight : float, optional
        Weight of the squared command, as a wavefront, beside the squared residual. A small
        one, such as 1e-4, is needed where the mirror has a zero on the unit circle (a settled
        one at a delay of half a frame), and keeps commands small near it.

    Returns
    -------
    LqgDesign
        Certified design; ``rms`` is the residual where the model is the truth. Without a
        command weight no linear controller leaves less.

    Raises
    ------
    ProblemError
        If the plant is none of :func:`tip_tilt_plant`, or an argument is out of its range.
    DimensionError
        If the mirror does not reach every mode.
    InfeasibleError
        If the mirror has a zero on the unit circle and there is no command weight.
    DetectabilityError
        If no stable filter exists.
    NumericalError
        If a Riccati equation is not solved.
    CertificateError
        If the design does not pass its checks.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> shell = lbt.models.PositionLoop.from_bandwidth(
    ...     natural_frequency_hz=20, damping=0.5, bandwidth_hz=100
    ... )
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, noise_nm=15.5, modes=1, mirror=shell
    ... )
    >>> design = lbt.lqg(plant)
    >>> loop = lbt.close_loop(plant.hardware, design.controller)
    >>> budget = lbt.residual_budget(loop, lbt.Truth(turbulence=slow, noise_nm=15.5))
    >>> bool(abs(budget.rms_nm / design.rms - 1) < 1e-6)
    True
    """
    if not isinstance(plant, TipTiltPlant):
        raise ProblemError(
            "lqg needs a TipTiltPlant, which knows its loop; got "
            f"{type(plant).__name__}. Try tip_tilt_plant."
        )
    rho = number(command_weight, "command_weight", at_least=0)
    hardware = plant.hardware
    rank = int(np.linalg.matrix_rank(hardware.influence))
    if rank < hardware.modes:
        raise DimensionError(
            f"influence_matrix must have rank {hardware.modes}, one for each mode, for a design "
            f"that counts the residual of all modes; got {hardware.influence.shape} of rank {rank}."
        )
    estimation = estimation_plant(plant)
    solution = kalman_riccati(estimation)
    regulator = _regulator(hardware.mirror_system.core, estimation.A, estimation.L, rho)
    innovation = estimation.R + estimation.C @ solution.P @ estimation.C.T
    drive = solution.gain_predictor @ innovation @ solution.gain_predictor.T
    gains = regulator.gain_state
    rest = estimation.L.T @ estimation.L - regulator.weight * gains.T @ gains
    cost = np.trace(estimation.L @ solution.P @ estimation.L.T)
    if np.any(np.abs(rest) > 1e-14 * np.max(np.abs(estimation.L)) ** 2):
        cost += np.trace(stationary_covariance(estimation.A.T, rest) @ drive)
    design = LqgDesign(
        method="lqg",
        controller=lqg_controller(plant, solution.gain_predictor, gains, regulator.gain_mirror),
        certificate=UNCERTIFIED,
        solver=SolverReport(
            route="riccati",
            status=f"{solution.status}; mirror: {regulator.status}",
            iterations=solution.iterations + regulator.iterations,
        ),
        problem=plant,
        gain_predictor=solution.gain_predictor,
        gain_state=frozen_copy(gains),
        gain_mirror=frozen_copy(regulator.gain_mirror),
        command_weight=rho,
        objective_nm=float(np.sqrt(max(float(cost), 0.0))),
    )
    return with_certificate(
        design, "Try a small command_weight, such as 1e-4, or states of similar sizes."
    )


def _regulator(core: Response, A: FloatArray, L: FloatArray, rho: float) -> Regulator:
    """Regulator of one mirror for all modes; the rows of L are their targets."""
    F, G, h, d = core.A, core.B, core.C, core.D
    weight = d**2 + rho
    if core.n_states == 0:
        return Regulator(d / weight * L, np.zeros(0), weight, "settled", 0)
    X, status, iterations = np.zeros_like(F), "inverted", 0
    zeros = np.abs(core.zeros)
    if rho == 0 and np.any(np.abs(zeros - 1) < _ON_CIRCLE):
        raise InfeasibleError(
            "without a command weight the mirror must have no zero on the unit circle; got one at "
            f"a modulus of {zeros[np.argmin(np.abs(zeros - 1))]:.9g}, where the commands would "
            "grow for ever. Try command_weight=1e-4, or another delay."
        )
    if rho > 0 or np.any(zeros > 1):  # otherwise the mirror's inverse is stable and costs nothing
        solved = solve_dare(F, G[:, None], np.outer(h, h), [[weight]], d * h[:, None])
        X, status, iterations = solved.X, solved.route, solved.iterations
    total = float(weight + G @ X @ G)
    gain_mirror = (G @ X @ F + d * h) / total
    closed = F - np.outer(G, gain_mirror)
    crossed = _solve_stein(closed.T, A, (gain_mirror * d - h)[None, :, None] * L[:, None, :])
    gain_state = (d * L - np.einsum("i,aij,jk->ak", G, crossed, A)) / total
    return Regulator(gain_state, gain_mirror, total, status, iterations)


def _solve_stein(left: FloatArray, right: FloatArray, drive: FloatArray) -> FloatArray:
    """Solve ``Y = left Y right + drive`` for a stack of drives, by squaring."""
    Y = drive
    for _ in range(_SQUARINGS):
        step = left @ Y @ right
        Y = Y + step
        if np.max(np.abs(step)) <= 1e-18 * max(float(np.max(np.abs(Y))), 1e-300):
            break
        left, right = left @ left, right @ right
    return np.asarray(Y)
