"""The controllers of a plant, by the Riccati equations of both sides, at any level of gamma.

The central controller: the disturbance is replaced by its distance from the worst one, and the
control by its distance from the best one; what is left is to estimate the best control from the
measurements. M. Green, D. J. N. Limebeer, "Linear Robust Control", Prentice-Hall (1995),
appendix B; A. A. Stoorvogel, "The H-infinity Control Problem", Prentice-Hall (1992), chapter 9.
The equation of one side is that of control with known state and disturbance; the other side, the
estimation of the state, is the same problem with all matrices transposed. With an infinite level
it is the controller of least variance.

All stabilising controllers: with ``u = u_least + R^(-1/2) q`` and
``q = Q S^(-1/2) innovation``, R and S the weights of control and innovation, every stable Q gives
one. From w to z the loop is ``T11 + T12 Q T21``, affine in Q, with T12 inner and T21 co-inner, and
its variance is the least one plus ``|Q|^2`` (D. C. Youla, H. A. Jabr, J. J. Bongiorno, IEEE Trans.
Autom. Control 21, 319 (1976), doi:10.1109/TAC.1976.1101223).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq

from lbt_synth.errors import NonFiniteError, NumericalError
from lbt_synth.linear.generalized_plant import GeneralizedPlant, invert_well_posed
from lbt_synth.linear.infeasibility_proof import slow_angles, steady_oscillation
from lbt_synth.linear.matrix_functions import nearest_powers_of_two, semidefinite_root
from lbt_synth.linear.norms import hinf_norm
from lbt_synth.linear.output_feedback.lower_bound import (
    ControlWitness,
    WorstCase,
    coupled_bursts,
    last_step,
)
from lbt_synth.linear.riccati.dare import require_seen, solve_dare
from lbt_synth.linear.riccati.equations import Equations, solve_by_doubling, solve_by_schur
from lbt_synth.linear.state_space import StateSpace
from lbt_synth.validation import FloatArray, require_instance

_TOLERANCE = 1e-11
_NOTHING = 1e-6  # part of the largest of levels, that counts as none
_PART = 1e-10  # of the largest singular value, below which a channel cancels nothing
_ROUNDING = 1e-9  # share of a solution that its residual, or a negative part, may be


class FullInformation:
    """Solves ``X`` of one side for any gamma, as the excess over the least-variance solution.

    With the law of least variance ``u = -feedback x - feedforward w``, what is left is a problem
    without state weight, so that doubling starts inside the reach of the stabilising solution and
    D12 may be singular. Of the side of estimation, transposed, ``weight`` is the covariance of
    the innovation and ``feedback`` its gain into the state.
    """

    def __init__(self, side: GeneralizedPlant) -> None:
        A, B1, B2, C1, D11, D12 = _side_matrices(side)
        dare = solve_dare(A, B2, C1.T @ C1, D12.T @ D12, C1.T @ D12)
        self.side, self.least = side, dare.X
        self.weight = D12.T @ D12 + B2.T @ dare.X @ B2
        self.feedback = dare.gain_feedback
        self.feedforward = np.linalg.solve(self.weight, B2.T @ dare.X @ B1 + D12.T @ D11)
        self.A, self.B = A - B2 @ self.feedback, B1 - B2 @ self.feedforward
        C, D = C1 - D12 @ self.feedback, D11 - D12 @ self.feedforward
        self.pushed = D.T @ D + self.B.T @ dare.X @ self.B
        self.cross = self.A.T @ dare.X @ self.B + C.T @ D
        self.reach = np.linalg.solve(np.linalg.cholesky(self.weight), B2.T).T

    def floor(self) -> float:
        """Level that no X can have: that of one step after rest."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.pushed)[-1], 0.0)))

    def solve(self, gamma: float) -> tuple[float, FloatArray | None]:
        """Return the slack of the last step's condition, and X where the slack is above 0.

        Next to the least level X may grow without bound, where doubling loses its digits: the
        ordered Schur form keeps them, and its slack goes on below that level. Where its eigenvalues
        lie on the circle its X solves nothing, and where the equation is ill scaled it has none.
        """
        equation, m = self._equation(gamma), self.B.shape[1]
        if np.linalg.eigvalsh(equation.R[0, :m, :m])[-1] >= 0:
            return -1.0, None
        slack = -1.0
        for route in (solve_by_schur, lambda e: solve_by_doubling(e)[0]):
            slack, X = self._judge(equation, route(equation), gamma)
            if X is not None:
                return slack, self.least + X
        return slack, None

    def _judge(
        self, equation: Equations, X: FloatArray, gamma: float
    ) -> tuple[float, FloatArray | None]:
        """Return the slack of a solution, and its X if it is one that a controller can have."""
        m, unit = self.B.shape[1], gamma**2 / max(float(np.sum(self.B**2)), 1e-300)
        gains, residual, relative = equation.evaluate(X)
        nothing = float(np.linalg.norm(residual)) < _ROUNDING * unit
        if not (nothing or relative[0] < _ROUNDING):
            return -1.0, None
        if np.max(np.abs(equation.poles(gains))) >= 1:
            return -1.0, None
        weights = equation.weights(X)[0]
        answer = np.linalg.solve(weights[m:, m:], weights[m:, :m])
        slack = -float(np.linalg.eigvalsh(weights[:m, :m] - weights[:m, m:] @ answer)[-1])
        if slack <= 0:
            return slack, None
        sizes = np.linalg.eigvalsh(X[0])
        negative = sizes[0] < -_ROUNDING * max(sizes[-1], unit)
        return (-1.0, None) if negative else (slack, X[0])

    def _equation(self, gamma: float) -> Equations:
        """Return the equation of the excess; disturbances are in units of the level."""
        (n, m), p = self.B.shape, self.reach.shape[1]
        return Equations(
            A=self.A[None],
            B=np.hstack([self.B / gamma, self.reach])[None],
            Q=np.zeros((1, n, n)),
            R=block_diag(self.pushed / gamma**2 - np.eye(m), np.eye(p))[None],
            S=np.hstack([self.cross / gamma, np.zeros((n, p))])[None],
        )

    def refine(self, X: FloatArray, gamma: float) -> FloatArray:
        """Return X after Newton steps on a residual in extended precision."""
        A, B1, B2, C1, D11, D12 = _side_matrices(self.side)
        D = np.hstack([D11, D12])
        R = D.T @ D - block_diag(gamma**2 * np.eye(B1.shape[1]), np.zeros((B2.shape[1],) * 2))
        parts = {"A": A, "B": np.hstack([B1, B2]), "Q": C1.T @ C1, "R": R, "S": C1.T @ D}
        equation = Equations(**{name: part[None] for name, part in parts.items()})
        return np.asarray(equation.refine(X[None]).X[0])

    def worst_case(self, X: FloatArray, gamma: float) -> WorstCase:
        """Return the worst case at a level, for its X."""
        A, B1, B2, C1, D11, D12 = _side_matrices(self.side)
        B, D, m = np.hstack([B1, B2]), np.hstack([D11, D12]), B1.shape[1]
        R = D.T @ D + B.T @ X @ B
        R[:m, :m] -= gamma**2 * np.eye(m)
        law = -np.linalg.solve(R, D.T @ C1 + B.T @ X @ A)
        answer = np.linalg.solve(R[m:, m:], R[m:, :m])
        last = np.linalg.eigh(R[:m, :m] - R[:m, m:] @ answer)[1][:, -1:]
        signals = np.vstack([last, -answer @ last])
        return WorstCase(A=A + B @ law, C=C1 + D @ law, entry=B @ signals, error=D @ signals)


def _side_matrices(side: GeneralizedPlant) -> tuple[FloatArray, ...]:
    """Return the matrices of control with known state and disturbance."""
    return side.A, side.B1, side.B2, side.C1, side.D11, side.D12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelSolution:
    """Solutions of both sides at a level."""

    gamma: float
    X: FloatArray
    Y: FloatArray


class TwoRiccati:
    """The two equations of a plant, at any level."""

    def __init__(self, plant: GeneralizedPlant) -> None:
        self.plant = plant
        self.control = FullInformation(plant)
        self.estimation = FullInformation(plant.transposed())

    def least_variance(self) -> StateSpace:
        """Return the controller of least variance."""
        return central_controller(self.plant, self.control.least, self.estimation.least)

    def controller(self, solution: LevelSolution) -> StateSpace:
        """Return the central controller of a solution."""
        X = self.control.refine(solution.X, solution.gamma)
        Y = self.estimation.refine(solution.Y, solution.gamma)
        return central_controller(self.plant, X, Y, solution.gamma)

    def solve(self, gamma: float) -> tuple[float, LevelSolution | None]:
        """Return the least slack of the three conditions, and the solutions where it is above 0."""
        try:
            slack, X = self.control.solve(gamma)
            other, Y = (-1.0, None) if X is None else self.estimation.solve(gamma)
            if X is None or Y is None:
                return -1.0, None
            root = semidefinite_root(X)
            coupling = 1 - float(np.linalg.eigvalsh(root.T @ Y @ root)[-1]) / gamma**2
        except np.linalg.LinAlgError:  # singular to working accuracy, as next to a level of zero
            return -1.0, None
        least = min(slack, other, coupling)
        return least, LevelSolution(gamma=gamma, X=X, Y=Y) if least > 0 else None

    def least_level(self) -> LevelSolution:
        """Return the solution at the least level, to a relative 1e-11.

        Raises a NumericalError if not even the level of the least variance has one.
        """
        solutions: dict[float, LevelSolution] = {}

        def slack(gamma: float) -> float:
            value, solution = self.solve(gamma)
            if solution is None:
                return min(value, -_TOLERANCE)  # at a slack of 0 there is no controller
            solutions[gamma] = solution
            return value

        loop = self.plant.closed_loop(self.least_variance())
        upper = hinf_norm(loop).upper if loop.spectral_radius < 1 else np.inf
        floors = self.control.floor(), self.estimation.floor()
        lower = max(*floors, _NOTHING * upper) * (1 - 1e-12) if np.isfinite(upper) else 0.0
        for growth in np.geomspace(1e-9, 1e9, 19):  # next to nothing rounding is larger
            if not np.isfinite(upper) or slack(upper * (1 + growth)) > 0:
                break
        if not solutions:
            raise NumericalError(
                "the Riccati equations have no solution at the level of the least variance. "
                "Scale states and signals to similar sizes.",
                status="search",
            )
        upper = min(solutions)
        if lower < upper and slack(lower) <= 0:
            brentq(slack, lower, upper, xtol=2 * _TOLERANCE * upper)  # its steps are half of it
        return solutions[min(solutions)]

    def proofs(self, solution: LevelSolution, plant: GeneralizedPlant) -> list[ControlWitness]:
        """Return what may prove of a plant, this or the one next to it, that no level is lower.

        Bursts belong to this plant alone. Steady oscillations have frequency zero, the highest one,
        and those of the slow poles of the worst cases. At levels next to zero there may be none.
        """
        out: list[ControlWitness] = []
        with suppress(np.linalg.LinAlgError):
            control = self.control.worst_case(solution.X, solution.gamma)
            estimation = self.estimation.worst_case(solution.Y, solution.gamma)
            cases = (
                ("unmoved", plant, control, solution.X, _CONTROL),
                ("unseen", plant.transposed(), estimation, solution.Y, _ESTIMATION),
            )
            for pairs, side, worst, cost, (reason, reason_at) in cases:
                shown = side.A.T, side.C1.T, side.B2.T, side.D12.T
                gained = side.B1.T, side.D11.T
                if plant is self.plant:
                    with suppress(NonFiniteError):  # of a worst case that rounding makes unstable
                        burst = {pairs: last_step(worst, cost)}
                        out.append(ControlWitness(**burst, reason=reason))
                for angle in (*slow_angles(worst.A)[:4], 0.0, np.pi):
                    steady = {pairs: steady_oscillation(shown, gained, angle)}
                    text = f"{reason_at} {angle / (2 * np.pi * plant.dt_s):.6g} Hz"
                    out.append(ControlWitness(**steady, reason=text))
            if plant is self.plant:
                with suppress(NonFiniteError):
                    unseen, unmoved = coupled_bursts(control, solution.X, estimation, solution.Y)
                    out.append(ControlWitness(unseen=unseen, unmoved=unmoved, reason=_COUPLED))
        return out


_COUPLED = "what is not seen in time cannot be made good in time"
_CONTROL = (
    "even a controller that knows the state and the disturbance leaves as much",
    "even a controller that knows the disturbance leaves as much at",
)
_ESTIMATION = (
    "even a control that reaches every state leaves as much, as the disturbance is unseen",
    "even a control that reaches every state leaves as much, unseen, at",
)


def central_controller(
    plant: GeneralizedPlant, X: FloatArray, Y: FloatArray, gamma: float = np.inf
) -> StateSpace:
    """Return the central controller, from y to u, of a level above the least one.

    X and Y (n, n) are the stabilising solutions of control and of estimation at the level; an
    infinite level is that of the least variance. NumericalError if it is not above the least one.
    """
    X, Y = np.asarray(X), np.asarray(Y)
    try:
        A, B1, C2, D21, F, F0, Z = _best_control(plant, X, Y, gamma)
        innovation = D21 @ D21.T + C2 @ Z @ C2.T
        seen = np.vstack([A, F]) @ Z @ C2.T + np.vstack([B1, F0]) @ D21.T
        state, control = np.split(_solve(innovation, seen.T).T, [len(A)])  # gains of it
    except np.linalg.LinAlgError as error:
        raise NumericalError(
            f"the level {gamma:.9g} has no controller to working accuracy: {error}. Try a larger "
            "gamma.",
            status="central controller",
        ) from error
    C, D = control @ C2 - F, -control
    observer = StateSpace(
        A=A - state @ C2 + plant.B2 @ C, B=state + plant.B2 @ D, C=C, D=D, dt_s=plant.dt_s
    )
    return with_seen_controls(observer, plant.D22)


def _best_control(
    plant: GeneralizedPlant, X: FloatArray, Y: FloatArray, gamma: float
) -> tuple[FloatArray, ...]:
    """Return A, B1, C2, D21 about the worst disturbance, the law (F, F0), and Z."""
    scale = gamma if np.isfinite(gamma) else 1.0
    B1, D11, D21, m = plant.B1 / scale, plant.D11 / scale, plant.D21 / scale, plant.sizes[0]
    A, B2, C1, D12, n = plant.A, plant.B2, plant.C1, plant.D12, len(plant.A)
    R3, R2 = D12.T @ D12 + B2.T @ X @ B2, D12.T @ D11 + B2.T @ X @ B1
    L2, L1 = B2.T @ X @ A + D12.T @ C1, B1.T @ X @ A + D11.T @ C1
    worst, unit, Z = np.zeros((m, n)), np.eye(m), Y
    if np.isfinite(gamma):
        least = D11.T @ D11 + B1.T @ X @ B1 - R2.T @ _solve(R3, R2) - np.eye(m)
        worst = -_solve(least, L1 - R2.T @ _solve(R3, L2))
        root = np.asarray(np.linalg.cholesky(-(least + least.T) / 2), dtype=np.float64)
        unit = _solve(root.T, unit)
        Z = _solve((np.eye(n) - X @ Y / scale**2).T, Y.T).T / scale**2
    law = _solve(R3, np.hstack([L2 + R2 @ worst, R2 @ unit]))
    return (
        *(A + B1 @ worst, B1 @ unit, plant.C2 + D21 @ worst, D21 @ unit),
        *(law[:, :n], law[:, n:], (Z + Z.T) / 2),
    )


def with_seen_controls(controller: StateSpace, D22: FloatArray) -> StateSpace:
    """Return the controller for measurements that see the control at once, by D22."""
    if not np.any(D22):
        return controller
    K = controller
    loop = invert_well_posed(-D22, K.D)  # (I + D22 D)^-1
    seen = loop @ np.hstack([-D22 @ K.C, np.eye(len(D22))])
    n = K.n_states
    step, out = K.B @ seen, K.D @ seen
    return StateSpace(
        A=K.A + step[:, :n], B=step[:, n:], C=K.C + out[:, :n], D=out[:, n:], dt_s=K.dt_s
    )


def _solve(M: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(M, right), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeParameter:
    """The loop of a plant in discrete time as an affine function of Q."""

    plant: GeneralizedPlant
    feedback: FloatArray  # (m2, n), F
    injection: FloatArray  # (n, p2), of the innovation into the state
    through: FloatArray  # (m2, p2), of the innovation into the control, negative
    control_unit: FloatArray  # (m2, m2), R^(-1/2)
    innovation_unit: FloatArray  # (p2, p2), S^(-1/2)
    T11: StateSpace
    T12: StateSpace
    T21: StateSpace

    def controller(self, taps: FloatArray) -> StateSpace:
        """Return the controller of a Q with finite response, its taps (T, m2, p2)."""
        P, n = self.plant, len(self.plant.A)
        p2 = P.sizes[3]
        stored = (len(taps) - 1) * p2
        # the innovation, and the control, as functions of [x; past innovations; y]
        innovation = np.hstack([-P.C2, np.zeros((p2, stored)), np.eye(p2)])
        unit = self.innovation_unit @ innovation
        control = (self.control_unit @ taps[0]) @ unit - self.through @ innovation
        control[:, :n] -= self.feedback
        if stored:
            control[:, n : n + stored] += self.control_unit @ np.hstack(list(taps[1:]))
        rows = np.zeros((n + stored, n + stored + p2))
        rows[:n, :n] = P.A
        rows[:n] += P.B2 @ control + self.injection @ innovation
        if stored:
            rows[n : n + p2] = unit
            rows[n + p2 :, n : n + stored - p2] = np.eye(stored - p2)
        size = n + stored
        K = StateSpace(
            A=rows[:, :size],
            B=rows[:, size:],
            C=control[:, :size],
            D=control[:, size:],
            dt_s=P.dt_s,
        )
        return with_seen_controls(K, P.D22)


def free_parameter(equations: TwoRiccati) -> FreeParameter:
    """Return the affine form of the loop of a plant, by its least-variance solutions."""
    P, control, estimation = equations.plant, equations.control, equations.estimation
    F, state = control.feedback, estimation.feedback.T
    seen = F @ estimation.least @ P.C2.T + control.feedforward @ P.D21.T
    through = np.linalg.solve(estimation.weight, seen.T).T
    control_unit = np.linalg.inv(np.linalg.cholesky(control.weight).T)
    innovation_unit = np.linalg.inv(np.linalg.cholesky(estimation.weight))
    dt_s = P.dt_s
    B2, D12 = P.B2 @ control_unit, P.D12 @ control_unit
    C2, D21 = innovation_unit @ P.C2, innovation_unit @ P.D21
    return FreeParameter(
        plant=P,
        feedback=F,
        injection=state,
        through=np.asarray(through),
        control_unit=np.asarray(control_unit),
        innovation_unit=np.asarray(innovation_unit),
        T11=P.closed_loop(equations.least_variance()),
        T12=StateSpace(A=P.A - P.B2 @ F, B=B2, C=P.C1 - P.D12 @ F, D=D12, dt_s=dt_s),
        T21=StateSpace(A=P.A - state @ P.C2, B=P.B1 - state @ P.D21, C=C2, D=D21, dt_s=dt_s),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaledPlant:
    """A plant as it was given, and as it is solved."""

    given: GeneralizedPlant
    plant: GeneralizedPlant  # states and signals scaled by powers of two
    unit: float  # a level of the scaled plant over that of the given one
    controls: FloatArray  # (m2,) u of a unit of the scaled u
    measurements: FloatArray  # (p2,) scaled y of a unit of y

    def closed_loop(self, controller: StateSpace) -> tuple[StateSpace, StateSpace]:
        """Return a controller of the scaled plant in the given units, and its loop."""
        K, u = controller, self.controls[:, None]
        K = replace(K, B=K.B * self.measurements, C=u * K.C, D=u * K.D * self.measurements)
        return K, self.given.closed_loop(K)

    def equations(self, share: float) -> TwoRiccati:
        """Return the equations of the plant, with a share of errors and disturbances added."""
        return TwoRiccati(regularise(self.plant, share) if share else self.plant)


def scaled_plant(plant: GeneralizedPlant) -> ScaledPlant:
    """Return the form in which a plant is solved; DetectabilityError if nothing stabilises it.

    States are balanced, and errors, disturbances, controls and measurements have size one, so that
    no unit is singular. What a control may cancel, D11, has no part in the sizes.
    """
    require_instance(plant, GeneralizedPlant, "plant")
    require_stabilisable(plant)
    sizes = _size(plant.C1, plant.D12), _size(plant.B1, plant.D21)
    z, w = (1 / float(nearest_powers_of_two(np.array([size]))[0]) for size in sizes)
    P = replace(
        plant,
        B1=w * plant.B1,
        C1=z * plant.C1,
        D11=z * w * plant.D11,
        D12=z * plant.D12,
        D21=w * plant.D21,
    )
    P = GeneralizedPlant.of(P.whole.balanced(), measurements=len(P.C2), controls=P.B2.shape[1])
    controls, measurements = _units(P.B2, P.D12), _units(P.C2.T, P.D21.T)
    y = measurements[:, None]
    scaled = replace(
        P,
        B2=P.B2 * controls,
        D12=P.D12 * controls,
        C2=y * P.C2,
        D21=y * P.D21,
        D22=y * P.D22 * controls,
    )
    return ScaledPlant(
        given=plant, plant=scaled, unit=z * w, controls=controls, measurements=measurements
    )


def _units(into: FloatArray, through: FloatArray) -> FloatArray:
    """Return powers of two that make columns of two matrices together of size about one."""
    size = np.hypot(np.linalg.norm(into, axis=0), np.linalg.norm(through, axis=0))
    return 1 / nearest_powers_of_two(size)


def regularise(plant: GeneralizedPlant, share: float) -> GeneralizedPlant:
    """Return the plant with small errors of each control and state, and small disturbances of both.

    ``share`` is their part of the plant's own errors and disturbances. A controller leaves no
    less in the regularised plant than in the plant itself, and in the limit as much. Where a
    constant control ``u = K y`` cancels much of D11, the errors are those of the distance from it,
    and it makes nothing of the disturbances of the measurements: they are relative to what is left.
    """
    P, n = plant, len(plant.A)
    m1, m2, p1, p2 = P.sizes
    K = -np.linalg.pinv(P.D12, rcond=_PART) @ P.D11 @ np.linalg.pinv(P.D21, rcond=_PART)
    cancelled, uncancelled = _sizes_under(P, K), _sizes_under(P, 0 * K)
    cancels = cancelled[0] * cancelled[1] < uncancelled[0] * uncancelled[1]
    K, sizes = (K, cancelled) if cancels else (0 * K, uncancelled)
    error, push = (share * size for size in sizes)
    C1 = np.vstack([P.C1, -error * K @ P.C2, error * np.eye(n)])
    D12 = np.vstack([P.D12, error * np.eye(m2), np.zeros((n, m2))])
    B1 = np.hstack([P.B1, -push * P.B2 @ K, push * np.eye(n)])
    D21 = np.hstack([P.D21, push * np.eye(p2), np.zeros((p2, n))])
    D11 = np.zeros((len(C1), B1.shape[1]))
    D11[:p1] = np.hstack([P.D11, -push * P.D12 @ K, np.zeros((p1, n))])
    D11[p1 : p1 + m2, : m1 + p2] = np.hstack([-error * K @ P.D21, -error * push * K])
    return replace(P, B1=B1, C1=C1, D11=D11, D12=D12, D21=D21)


def _sizes_under(P: GeneralizedPlant, K: FloatArray) -> tuple[float, float]:
    """Return the sizes of errors and disturbances under a constant control (m2, p2)."""
    through = P.D11 + P.D12 @ K @ P.D21
    errors = _size(P.C1 + P.D12 @ K @ P.C2, P.D12, through)
    return errors, _size(P.B1 + P.B2 @ K @ P.D21, P.D21, through)


def _size(*parts: FloatArray) -> float:
    return max(float(np.linalg.norm(part, 2)) for part in parts) or 1.0


def require_stabilisable(plant: GeneralizedPlant) -> None:
    """Raise if a mode that does not decay is not reached by u, or not seen by y."""
    words = (
        "no controller stabilises the plant: its mode at {{mode}} does not decay, and {}, or take "
        "it out of the plant (a weight with such a pole: let it decay a little). The mode is made "
        "of the states {{states}}."
    )
    reached = words.format("no control reaches it. Give it a control")
    require_seen(plant.A.T, plant.B2.T, reached, drive=plant.C1.T)
    seen = words.format("no measurement sees it. Measure it")
    require_seen(plant.A, plant.C2, seen, drive=plant.B1)
