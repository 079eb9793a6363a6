"""LQG: the Kalman filter, and the commands that bring a mirror with dynamics to its estimate.

The disturbance is estimated from the pseudo-open-loop measurement, which the commands do not
touch; a linear-quadratic regulator on [disturbance; mirror] chooses the commands. The mirror
is the same for all commands, so that the regulator is one scalar Riccati problem of the
mirror's few states and one linear equation for the disturbance (C. Correia, H.-F. Raynaud,
C. Kulcsar, J.-M. Conan, J. Opt. Soc. Am. A 27, 333 (2010), doi:10.1364/JOSAA.27.000333).

The camera sees the mirror at every moment. A command holds for one frame, which is cut into pieces
of length w_g. With the mirror's core ``m(k+1) = F m(k) + G v(k)``, its mean position ``c_g(k) = h_g
m(k) + d_g v(k)`` in a piece, one frame of one mode, ``v = (N u)_i`` and the phase ``z_g(k) = l_g
x(k+1)`` there, interpolated between means over frames::

    minimise  E sum_g w_g (z_g(k) - c_g(k))^2 + rho v(k)^2

A settled mirror has one piece, and the law is that of the Kalman filter whatever the delay.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from lbt_synth.design.certificate import (
    TOLERANCE,
    Check,
    Claim,
    Evidence,
    certify_error,
    certify_filter,
    measured_claim,
)
from lbt_synth.design.result import (
    MODEL_LIMITS,
    Design,
    SolverReport,
    model_limits,
    with_certificate,
)
from lbt_synth.errors import DimensionError
from lbt_synth.linear import Controller, StateSpace, solve_dare
from lbt_synth.linear.lyapunov import output_variances, stationary_covariance, stationary_root
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.mirror.frame_rate_system import Response, tapped_mirror
from lbt_synth.models.plant.assembly import held_frames
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.storage.rows import Column
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, number, require_instance

Vector: TypeAlias = FloatArray  # which may be empty


def _check_objective(evidence: Evidence, objective_nm: float) -> Iterator[Check]:
    """Compare the cost of the real loop, by a Lyapunov equation, with the claimed one."""
    design, rms = evidence.design, evidence.certificate.rms
    residual, commands = loop_variances(design.problem, design.controller)
    cost = residual + design.command_weight * commands
    pairs = (
        ("residual of the closed loop, against the error system", residual, rms**2),
        ("objective of the closed loop, against the one claimed", cost, objective_nm**2),
    )
    for name, value, claimed in pairs:
        apart = abs(value / claimed - 1) if claimed > 0 else value
        how = "relative, Lyapunov equation of the whole loop"
        yield Check(name, apart, TOLERANCE, how)


def _check_weight(evidence: Evidence, rho: float) -> Iterator[Check]:
    """Check that a step of policy iteration from the cost of this law finds no better law."""
    design = evidence.design
    model, core, pieces = design.estimation, mirror_core(design.problem), _pieces(design.problem)
    n, c = model.n_states, core.n_states
    whole = np.zeros((n + c, n + c))
    whole[:n, :n], whole[n:, n:] = model.A, core.A
    entry = np.concatenate([np.zeros(n), core.B])
    worst = 0.0
    for target, gain in zip(pieces.L.swapaxes(0, 1), design.gain_state, strict=True):
        law = np.concatenate([gain, -design.gain_mirror])
        rows = np.hstack([target, -pieces.C])
        closed = whole + np.outer(entry, law)
        left = rows - np.outer(pieces.D, law)
        X = stationary_covariance(closed.T, left.T @ left + rho * np.outer(law, law))
        weight = pieces.D @ pieces.D + rho + entry @ X @ entry
        better = (pieces.D @ rows - entry @ X @ whole) / weight
        size = max(float(np.linalg.norm(better)), 1e-300)
        worst = max(worst, float(np.linalg.norm(law - better)) / size)
    how = "gains recomputed from a Lyapunov equation"
    yield Check("distance from the least-cost regulator", worst, TOLERANCE, how)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LqgDesign(Design):
    """A Kalman filter, and a regulator that knows the mirror.

    The commands are ``N u(k) = gain_state x_hat(k+1|k) - N gain_mirror m(k)``, with x the
    states of :attr:`estimation` and m those of the mirror's core, one set a command. The
    error, with ``rms`` and ``gamma``, is the residual of the loop in the pieces of a hold.
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
    gain_predictor: FloatArray  # (n, q): Kalman gain of the estimation
    gain_state: FloatArray  # (modes, n): from the predicted disturbance to each mode's command
    gain_mirror: Vector  # (c,): from the states of the mirror's core to the command

    def __post_init__(self) -> None:
        model, mirror = self.estimation, mirror_core(self.problem)
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
        hardware = self.problem.hardware  # whose states of mirror and delay the law reads, too
        full = replace(self.estimation, hardware=hardware).full()
        states, law = len(self.gain_predictor), np.zeros((hardware.modes, full.n_states))
        law[:, :states] = self.gain_state
        end = states + self.gain_mirror.size * hardware.n_commands
        law[:, states:end] = -np.kron(self.gain_mirror, hardware.influence)
        return full.controller(self.gain_predictor, hardware.projector @ law)

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
        """The plant of the filter, whose state holds the phase while the next command holds."""
        return estimation_plant(self.problem)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the closed loop: of the filter and of the regulated mirror."""
        mirror = mirror_core(self.problem)
        closed = mirror.A - np.outer(mirror.B, self.gain_mirror)
        of_filter = self.estimation.error_system(self.gain_predictor).poles
        return np.concatenate([of_filter, np.linalg.eigvals(closed).astype(np.complex128)])

    def error_system(self) -> StateSpace:
        """System from w to the residual; its states are estimation error, estimate and mirror."""
        model, K = self.estimation, self.gain_predictor
        core, pieces, modes = mirror_core(self.problem), _pieces(self.problem), len(model.L)
        n, each = model.n_states, np.eye(modes)
        size = 2 * n + core.n_states * modes
        e, x, m = slice(0, n), slice(n, 2 * n), slice(2 * n, size)
        A, B = np.zeros((size, size)), np.zeros((size, model.B.shape[1]))
        A[e, e] = model.A - K @ model.C
        A[x, e], A[x, x] = K @ model.C, model.A
        A[m, x] = np.kron(core.B[:, None], self.gain_state)
        A[m, m] = np.kron(core.A - np.outer(core.B, self.gain_mirror), each)
        B[e], B[x] = model.B - K @ model.D, K @ model.D
        C = np.zeros((len(pieces.D), modes, size))
        C[..., e] = pieces.L
        C[..., x] = pieces.L - pieces.D[:, None, None] * self.gain_state
        seen = pieces.C - np.outer(pieces.D, self.gain_mirror)
        C[..., m] = -np.stack([np.kron(row, each) for row in seen])
        D = np.zeros((len(pieces.D) * modes, B.shape[1]))
        return StateSpace(A=A, B=B, C=C.reshape(-1, size), D=D, dt_s=model.dt_s)

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


def estimation_plant(plant: TipTiltPlant) -> TipTiltPlant:
    """Plant whose state holds the phase in the frames in which the next command holds."""
    hardware = plant.hardware
    if hardware.mirror is None:
        return plant
    newest = int(np.floor(hardware.delay_frames + 0.5))  # frame in which the hold ends
    waiting = replace(hardware, delay_frames=newest + 1, mirror=None)
    return assemble(replace(plant.parts(), hardware=waiting))


def mirror_core(plant: TipTiltPlant) -> Response:
    """Return the states of the mirror that a command moves in its hold; a settled one has none."""
    hardware = plant.hardware
    return tapped_mirror(np.ones(1)) if hardware.mirror is None else hardware.mirror_system.core


class Pieces(NamedTuple):
    """Phase and mirror in the pieces of a hold, each times the root of its length."""

    L: FloatArray  # (g, modes, n): phase, over the states of the estimation
    C: FloatArray  # (g, c): position, over the states of the mirror's core
    D: FloatArray  # (g,): position, over the command


def _pieces(plant: TipTiltPlant) -> Pieces:
    """Return what counts of a plant while a command holds; its model is the estimation's."""
    hardware, model = plant.hardware, estimation_plant(plant)
    if hardware.mirror is None:
        return Pieces(model.L[None], np.zeros((1, 0)), np.ones(1))
    hold, n = hardware.mirror_system.hold, hardware.modes
    newest = int(model.hardware.delay_frames) - 1
    held = held_frames(model.hardware)
    # the phase in the frames newest, newest - 1, ... after exposure k, over x(k + 1)
    past = [np.eye(n, model.n_states, model.n_states - (held - i) * n) for i in range(held)]
    frames = np.stack([model.L, *past])
    middle = hold.start + (hold.edges[1:] + hold.edges[:-1]) / 2 - 0.5
    age = np.clip(np.floor(newest - middle).astype(np.int64), 0, held - 1)
    later = (middle - (newest - age - 1))[:, None, None]  # weight of the later frame
    L = later * frames[age] + (1 - later) * frames[age + 1]
    root = np.sqrt(hold.weights)
    return Pieces(root[:, None, None] * L, root[:, None] * hold.C, root * hold.D)


def loop_variances(plant: TipTiltPlant, controller: Controller) -> tuple[float, float]:
    """Variances of residual in a hold, and command (as a wavefront), in the model of a plant."""
    hardware, model, pieces = plant.hardware, estimation_plant(plant), _pieces(plant)
    loop = close_loop(hardware, controller).system
    n, m, states = hardware.modes, hardware.n_commands, model.n_states
    # the loop meets the phase of frame k, the last that x(k + 1) holds
    held = np.eye(n, states, states - n)
    entry = loop.B[:, :n] @ held
    A = np.block([[model.A, np.zeros((states, loop.n_states))], [entry @ model.A, loop.A]])
    B = np.vstack([model.B, entry @ model.B + loop.B[:, n:] @ model.D])
    root = stationary_root(A, B)
    u = slice(n, n + m)
    command_C = np.hstack([loop.D[u, :n] @ held @ model.A, loop.C[u]])
    command_D = loop.D[u, :n] @ held @ model.B + loop.D[u, n:] @ model.D
    shape, first = hardware.influence, states + controller.n_states
    hold = hardware.mirror_system.hold
    root_length = np.sqrt(hold.weights)[:, None, None]
    positions = hold.positions(shape, (command_C, command_D), first)
    C, D = (-root_length * rows for rows in positions)
    C[..., :states] += pieces.L @ model.A
    D += pieces.L @ model.B
    C, D = C.reshape(-1, C.shape[-1]), D.reshape(-1, D.shape[-1])
    power = np.sum(output_variances(C, D, root))
    commands = output_variances(shape @ command_C, shape @ command_D, root)
    return float(power), float(np.sum(commands))


def lqg(plant: TipTiltPlant, *, command_weight: float = 0.0) -> LqgDesign:
    """Design the controller of least residual in the image, for a mirror that moves.

    For a mirror that settles at once it is the Kalman controller.

    Parameters
    ----------
    plant : TipTiltPlant
        Disturbance, noise and loop; the dynamics are those of ``plant.hardware.mirror``.
    command_weight : float, optional
        Weight of the squared command, as a wavefront, beside the squared residual.

    Returns
    -------
    LqgDesign
        Certified design; ``rms`` is the residual while commands hold, where the model is the truth.
        Without a command weight no linear controller leaves less.

    Raises
    ------
    ProblemError
        If the plant is none of :func:`tip_tilt_plant`, or an argument is out of its range.
    DimensionError
        If the mirror does not reach every mode.
    DetectabilityError, NumericalError, CertificateError
        As :func:`kalman`.

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
    >>> kalman = lbt.close_loop(plant.hardware, lbt.kalman(plant).controller)
    >>> truth = lbt.Truth(turbulence=slow, noise_nm=15.5)
    >>> [round(lbt.residual_budget(one, truth).rms_nm) for one in (loop, kalman)]
    [146, 165]
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
    pieces = _pieces(plant)
    gains, gain_mirror, weight, route = _regulator(mirror_core(plant), pieces, estimation.A, rho)
    innovation = estimation.R + estimation.C @ solution.P @ estimation.C.T
    drive = solution.gain_predictor @ innovation @ solution.gain_predictor.T
    L = pieces.L.reshape(-1, estimation.n_states)
    rest = L.T @ L - weight * gains.T @ gains
    cost = np.trace(L @ solution.P @ L.T)
    if np.any(np.abs(rest) > 1e-14 * np.max(np.abs(estimation.L)) ** 2):
        cost += np.trace(stationary_covariance(estimation.A.T, rest) @ drive)
    design = LqgDesign(
        method="lqg",
        solver=SolverReport(route="riccati", status=f"{solution.status}; mirror: {route}"),
        problem=plant,
        gain_predictor=solution.gain_predictor,
        gain_state=frozen_copy(gains),
        gain_mirror=frozen_copy(gain_mirror),
        claims={"command_weight": rho, "objective_nm": float(np.sqrt(max(float(cost), 0.0)))},
    )
    return with_certificate(
        design, "Try a small command_weight, such as 1e-4, or states of similar sizes."
    )


def _regulator(
    core: Response, pieces: Pieces, A: FloatArray, rho: float
) -> tuple[FloatArray, FloatArray, float, str]:
    """Return the gains of one mirror for all modes, ``d^2 + rho + G'XG``, and the route."""
    F, G, (L, h, d) = core.A, core.B, pieces
    weight = float(d @ d) + rho
    if core.n_states == 0:
        gain_state = np.einsum("g,gan->an", d, L) / weight
        return gain_state, np.zeros(0), weight, "settled"
    solved = solve_dare(F, G[:, None], h.T @ h, [[weight]], (d @ h)[:, None])
    X = solved.X
    total = float(weight + G @ X @ G)
    gain_mirror = (G @ X @ F + d @ h) / total
    closed = F - np.outer(G, gain_mirror)
    left = np.outer(d, gain_mirror) - h
    # the solution of Y = closed' Y A + drive, in which the modes are drives
    drives = np.einsum("gc,gan->cna", left, L).reshape(-1, L.shape[1])
    stein = np.eye(len(drives)) - np.kron(closed.T, A.T)
    crossed = np.linalg.solve(stein, drives).T.reshape(-1, *map(len, (F, A)))
    gain_state = (np.einsum("g,gan->an", d, L) - np.einsum("i,aij,jk->ak", G, crossed, A)) / total
    return gain_state, gain_mirror, total, solved.route
