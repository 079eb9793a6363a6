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

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    VARIANCE_TOLERANCE,
    Check,
    certify_error,
    certify_filter,
)
from lbt_synth.design.claims import Claim, Evidence, measured_claim
from lbt_synth.design.result import (
    MODEL_LIMITS,
    Design,
    SolverReport,
    model_limits,
    with_certificate,
)
from lbt_synth.errors import DimensionError, InfeasibleError, ProblemError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace, solve_dare
from lbt_synth.linear.lyapunov import output_variances, stationary_covariance, stationary_root
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.storage.rows import Column
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    frozen_copy,
    number,
    require_instance,
)

_ON_CIRCLE = 1e-6  # a zero this close to the unit circle leaves no stable regulator
_SQUARINGS = 60
Vector: TypeAlias = FloatArray  # which may be empty


def _check_objective(evidence: Evidence, objective_nm: float) -> Iterator[Check]:
    """Compare the cost of the real loop, by a Lyapunov equation, with the claimed one."""
    design, rms = evidence.design, evidence.certificate.rms
    residual, commands = loop_variances(design.problem, design.estimation, design.controller)
    cost = residual + design.command_weight * commands
    pairs = (
        ("residual of the closed loop, against the error system", residual, rms**2),
        ("objective of the closed loop, against the one claimed", cost, objective_nm**2),
    )
    for name, value, claimed in pairs:
        apart = abs(value / claimed - 1) if claimed > 0 else value
        how = "relative, Lyapunov equation of the whole loop"
        yield Check(name, apart, VARIANCE_TOLERANCE, how)


def _check_weight(evidence: Evidence, rho: float) -> Iterator[Check]:
    """Check that a step of policy iteration from the cost of this law finds no better law."""
    design = evidence.design
    model, core = design.estimation, design.problem.hardware.mirror_system.core
    n, c = model.n_states, core.n_states
    whole = np.zeros((n + c, n + c))
    whole[:n, :n], whole[n:, n:] = model.A, core.A
    entry = np.concatenate([np.zeros(n), core.B])
    worst = 0.0
    for target, gain in zip(model.L, design.gain_state, strict=True):
        law = np.concatenate([gain, -design.gain_mirror])
        row = np.concatenate([target, -core.C])
        closed = whole + np.outer(entry, law)
        left = row - core.D * law
        X = stationary_covariance(closed.T, np.outer(left, left) + rho * np.outer(law, law))
        weight = core.D**2 + rho + entry @ X @ entry
        better = (core.D * row - entry @ X @ whole) / weight
        size = max(float(np.linalg.norm(better)), 1e-300)
        worst = max(worst, float(np.linalg.norm(law - better)) / size)
    how = "gains recomputed from a Lyapunov equation"
    yield Check("distance from the least-cost regulator", worst, GAIN_TOLERANCE, how)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LqgDesign(Design):
    """A Kalman filter, and a regulator that knows the mirror.

    The commands are ``N u(k) = gain_state x_hat(k+1|k) - N gain_mirror m(k)``, with x the
    states of :attr:`estimation` and m those of the mirror's core, one set a command. The
    error, with ``rms`` and ``gamma``, is the residual of the loop.

    Attributes
    ----------
    problem : TipTiltPlant
        The plant, with the loop and the mirror.
    gain_predictor : (n, q) ndarray
        Kalman gain of the estimation.
    gain_state : (modes, n) ndarray
        From the predicted disturbance to the command of each mode.
    gain_mirror : (c,) ndarray
        From the states of the mirror's core to the command.
    """

    CLAIMS: ClassVar[tuple[Claim, ...]] = (
        measured_claim("rms", "residual, rms"),
        measured_claim("gamma", "residual, H-infinity norm"),
        Claim(name="command_weight", heading="weight of the command", checks=_check_weight),
        Claim(name="objective_nm", heading="root of the cost", unit="nm", checks=_check_objective),
    )
    DERIVED: ClassVar[tuple[Column, ...]] = MODEL_LIMITS
    is_estimator: ClassVar[bool] = True

    problem: TipTiltPlant
    gain_predictor: FloatArray
    gain_state: FloatArray
    gain_mirror: Vector

    def __post_init__(self) -> None:
        model, mirror = self.estimation, self.problem.hardware.mirror_system.core
        sizes = {
            "gain_predictor": model.C.T.shape,
            "gain_state": model.L.shape,
            "gain_mirror": (mirror.n_states,),
        }
        for name, size in sizes.items():
            if (shape := getattr(self, name).shape) != size:
                raise DimensionError(
                    f"{name} must be {size} to match the plant and the mirror; got {shape}."
                )
        Design.__post_init__(self)

    def make_controller(self) -> Controller:
        """Return the controller of the filter and the regulator."""
        gains = self.gain_predictor, self.gain_state, self.gain_mirror
        return lqg_controller(self.problem, *gains)

    @property
    def command_weight(self) -> float:
        """Weight of the squared command beside the squared residual."""
        return float(self.claims["command_weight"])

    @property
    def objective_nm(self) -> float:
        """Root of the least objective, by the Riccati equations [nm]."""
        return float(self.claims["objective_nm"])

    def derived(self) -> dict[str, float | None]:
        """Return residual and limit in the own model."""
        return dict(model_limits(self))

    @property
    def estimation(self) -> TipTiltPlant:
        """The plant of the filter: its z is the phase that the next command first acts on."""
        return estimation_plant(self.problem)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop: of the filter and of the regulated mirror."""
        mirror = self.problem.hardware.mirror_system.core
        closed = mirror.A - np.outer(mirror.B, self.gain_mirror)
        of_filter = self.estimation.error_system(self.gain_predictor).poles
        return np.concatenate([of_filter, np.linalg.eigvals(closed).astype(np.complex128)])

    def error_system(self, problem: EstimationProblem | None = None) -> StateSpace:
        """System from w to the residual of the loop.

        Parameters
        ----------
        problem : EstimationProblem, optional
            A TipTiltPlant of the same loop and as many states, with other disturbances; the
            design's own by default.

        Returns
        -------
        StateSpace
            States: estimation error, estimate, mirror.

        Raises
        ------
        ProblemError
            If the other problem is no plant of as many states.
        """
        own = self.estimation
        real = own
        if problem is not None:
            plant = require_instance(problem, TipTiltPlant, "problem")
            real = estimation_plant(replace(plant, hardware=self.problem.hardware))
            if real.A.shape != own.A.shape:
                raise ProblemError(
                    f"the other plant must have {own.n_states} states to be estimated; got "
                    f"{real.n_states}."
                )
        core, K, modes = self.problem.hardware.mirror_system.core, self.gain_predictor, len(own.L)
        n, each = own.n_states, np.eye(modes)
        size = 2 * n + core.n_states * modes
        e, x, m = slice(0, n), slice(n, 2 * n), slice(2 * n, size)
        A, B = np.zeros((size, size)), np.zeros((size, own.B.shape[1]))
        A[e, e] = real.A - K @ real.C
        A[e, x] = real.A - own.A - K @ (real.C - own.C)
        A[x, e], A[x, x] = K @ real.C, own.A + K @ (real.C - own.C)
        A[m, x] = np.kron(core.B[:, None], self.gain_state)
        A[m, m] = np.kron(core.A - np.outer(core.B, self.gain_mirror), each)
        B[e], B[x] = real.B - K @ real.D, K @ real.D
        C = np.zeros((modes, size))
        C[:, e], C[:, x] = real.L, real.L - core.D * self.gain_state
        C[:, m] = -np.kron(core.C - core.D * self.gain_mirror, each)
        D = np.zeros((modes, B.shape[1]))
        return StateSpace(A=A, B=B, C=C, D=D, dt_s=own.dt_s)

    def examine(self) -> Evidence:
        """Compute the norms of the residual, and check the filter's gain."""
        certificate = certify_error(
            self.error_system(), stability="spectral radius of model, filter and mirror"
        )
        checks = list(certificate.checks)
        if checks[0].passed:
            kalman = certify_filter(self.estimation, self.gain_predictor, least_variance=True)
            checks += [check for check in kalman.checks if check.name.startswith("distance")]
        return Evidence(design=self, certificate=replace(certificate, checks=tuple(checks)))


def lqg_controller(
    plant: TipTiltPlant, gain_predictor: FloatArray, gain_state: FloatArray, gain_mirror: FloatArray
) -> Controller:
    """Make the controller from y(k) to u(k): the filter, and the states of mirror and delay."""
    hardware = plant.hardware
    full = replace(estimation_plant(plant), hardware=hardware).full()
    n, (states, q) = full.n_states, gain_predictor.shape
    law, gain = np.zeros((hardware.modes, n)), np.zeros((n, q))
    law[:, :states], gain[:states] = gain_state, gain_predictor
    end = states + gain_mirror.size * hardware.n_commands
    law[:, states:end] = -np.kron(gain_mirror, hardware.influence)
    return replace(full, L=law).controller(gain)


def estimation_plant(plant: TipTiltPlant) -> TipTiltPlant:
    """Plant whose z is the phase on which the next command first acts."""
    hardware = plant.hardware
    delay = hardware.mirror_system.lead + 1
    if hardware.mirror is None and hardware.delay_frames == delay:
        return plant
    waiting = replace(hardware, delay_frames=delay, mirror=None)
    return assemble(replace(plant.parts(), hardware=waiting))


def loop_variances(
    plant: TipTiltPlant, model: TipTiltPlant, controller: Controller
) -> tuple[float, float]:
    """Variances of residual and command (as a wavefront) where the model is the truth."""
    hardware = plant.hardware
    loop = close_loop(hardware, controller).system
    n, m, states = hardware.modes, hardware.n_commands, model.n_states
    total = loop.B[:, :n] @ model.L
    A = np.block([[model.A, np.zeros((states, loop.n_states))], [total, loop.A]])
    B = np.vstack([model.B, loop.B[:, n:] @ model.D])
    root = stationary_root(A, B)
    powers = []
    for rows, shape in ((slice(n), np.eye(n)), (slice(n, n + m), hardware.influence)):
        C = shape @ np.hstack([loop.D[rows, :n] @ model.L, loop.C[rows]])
        D = shape @ loop.D[rows, n:] @ model.D
        powers.append(float(np.sum(output_variances(C, D, root))))
    return powers[0], powers[1]


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
    require_instance(plant, TipTiltPlant, "plant")
    rho = number(command_weight, "command_weight", at_least=0)
    plant.require_own_sensor("lqg")
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
        solver=SolverReport(
            route="riccati",
            status=f"{solution.status}; mirror: {regulator.status}",
            iterations=solution.iterations + regulator.iterations,
        ),
        problem=plant,
        gain_predictor=solution.gain_predictor,
        gain_state=frozen_copy(gains),
        gain_mirror=frozen_copy(regulator.gain_mirror),
        claims={"command_weight": rho, "objective_nm": float(np.sqrt(max(float(cost), 0.0)))},
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
