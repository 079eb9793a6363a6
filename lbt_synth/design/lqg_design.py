"""The LQG design: filter, regulator and controller, and their certificate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.design.certificate import (
    GAIN_TOLERANCE,
    VARIANCE_TOLERANCE,
    Certificate,
    Check,
    certify_error,
    certify_filter,
    certify_loop,
    controller_difference,
)
from lbt_synth.design.result import EstimatorDesign
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.linear.lyapunov import stationary_covariance
from lbt_synth.loop import close_loop
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.plant.tip_tilt import assemble
from lbt_synth.validation import ComplexArray, FloatArray

_SAME = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LqgDesign(EstimatorDesign):
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
    command_weight : float
        Weight of the squared command beside the squared residual.
    objective_nm : float
        Root of the least objective, by the Riccati equations [nm].
    """

    problem: TipTiltPlant
    gain_predictor: FloatArray
    gain_state: FloatArray
    gain_mirror: FloatArray
    command_weight: float
    objective_nm: float

    @property
    def knows_mirror(self) -> bool:
        """True: the regulator knows the mirror."""
        return True

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
            if not isinstance(problem, TipTiltPlant):
                raise ProblemError(
                    "the other disturbances of an LQG design must come in a TipTiltPlant; got "
                    f"{type(problem).__name__}."
                )
            real = estimation_plant(replace(problem, hardware=self.problem.hardware))
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

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices."""
        certificate = certify_error(
            self.error_system(), stability="spectral radius of model, filter and mirror"
        )
        checks = list(certificate.checks)
        if checks[0].passed:
            own = certify_filter(self.estimation, self.gain_predictor, least_variance=True)
            checks += [c for c in own.checks if c.name.startswith("distance")]
            checks.append(self._regulator_check())
        rebuilt = lqg_controller(
            self.problem, self.gain_predictor, self.gain_state, self.gain_mirror
        )
        apart = controller_difference(self.controller, rebuilt)
        checks += [
            Check("controller against its gains", apart, _SAME, "matrices assembled again"),
            certify_loop(self.problem.hardware, self.controller),
        ]
        if checks[-1].passed:
            checks += self._cost_checks(certificate.rms)
        return replace(certificate, checks=tuple(checks))

    def _regulator_check(self) -> Check:
        """Check that a step of policy iteration from the cost of this law finds no better law."""
        core, rho = self.problem.hardware.mirror_system.core, self.command_weight
        own = self.estimation
        n, c = own.n_states, core.n_states
        whole = np.zeros((n + c, n + c))
        whole[:n, :n], whole[n:, n:] = own.A, core.A
        entry = np.concatenate([np.zeros(n), core.B])
        worst = 0.0
        for target, gain in zip(own.L, self.gain_state, strict=True):
            law = np.concatenate([gain, -self.gain_mirror])
            row = np.concatenate([target, -core.C])
            closed = whole + np.outer(entry, law)
            left = row - core.D * law
            X = stationary_covariance(closed.T, np.outer(left, left) + rho * np.outer(law, law))
            weight = core.D**2 + rho + entry @ X @ entry
            better = (core.D * row - entry @ X @ whole) / weight
            size = max(float(np.linalg.norm(better)), 1e-300)
            worst = max(worst, float(np.linalg.norm(law - better)) / size)
        how = "gains recomputed from a Lyapunov equation"
        return Check("distance from the least-cost regulator", worst, GAIN_TOLERANCE, how)

    def _cost_checks(self, rms: float) -> list[Check]:
        """Compare the cost of the real loop, by a Lyapunov equation, with the claimed one."""
        residual, commands = loop_variances(self.problem, self.estimation, self.controller)
        cost = residual + self.command_weight * commands
        pairs = (
            ("residual of the closed loop, against the error system", residual, rms**2),
            ("objective of the closed loop, against the one claimed", cost, self.objective_nm**2),
        )
        how, checks = "relative, Lyapunov equation of the whole loop", []
        for name, found, claimed in pairs:
            apart = abs(found / claimed - 1) if claimed > 0 else found
            checks.append(Check(name, apart, VARIANCE_TOLERANCE, how))
        return checks


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
    covariance = stationary_covariance(A, B @ B.T)
    powers = []
    for rows, shape in ((slice(n), np.eye(n)), (slice(n, n + m), hardware.influence)):
        C = shape @ np.hstack([loop.D[rows, :n] @ model.L, loop.C[rows]])
        D = shape @ loop.D[rows, n:] @ model.D
        powers.append(float(np.trace(C @ covariance @ C.T) + np.trace(D @ D.T)))
    return powers[0], powers[1]
