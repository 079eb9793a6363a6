"""The Riccati equations of the Kalman and the H-infinity predictor, and the least gamma.

One sample of a recursion ``P+ = A P (I + G P)^-1 A' + H`` is the triple (A, G, H). The triples of
a period are joined into one, whose fixed point is found; a sweep through the period then gives the
solution of each phase. A problem that is constant is one of a single phase. Measurements that are
not read are left out, and have no gain; all are in units of their noise.

B. Hassibi, A. H. Sayed, T. Kailath, "Indefinite-Quadratic Estimation and
Control", SIAM (1999), doi:10.1137/1.9781611970760, chapter 4 (a-priori filter).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache, reduce

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq

from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.estimation_problem import (
    EstimationProblem,
    decorrelate,
    error_units,
    scale_states,
)
from lbt_synth.linear.matrix_functions import (
    as_stack,
    nearest_powers_of_two,
    relative_distance,
    symmetrise,
)
from lbt_synth.linear.riccati.dare import ERROR_LIMIT, require_seen, solve_dare, weight_root
from lbt_synth.linear.riccati.equations import Equations, doubling
from lbt_synth.validation import FloatArray, frozen_copy

_RESIDUAL_LIMIT = 1e-9  # relative, of a gamma-Riccati equation; checked by its refusal
_GAMMA_TOLERANCE = 4e-12  # relative, of the search: a few times the rounding of a slack
_INDEFINITE = 1e-6  # share of X that poles near the unit circle may leave below zero in a doubling

_Triple = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterRiccati:
    """A solved filter equation; with a longer period its matrices have an axis of phases."""

    # (n, n) or (N, n, n): covariance of the prediction error (Kalman), or its H-infinity
    # counterpart
    P: FloatArray
    # (n, q) or (N, n, q): gains of the measurement and the time update together; zero for what is
    # not read
    gain_predictor: FloatArray
    iterations: int  # number of doublings, or of steps of the solver
    status: str  # the route that gave P, or what the solver reports; no certificate uses it


def require_detectable(problem: EstimationProblem) -> None:
    """Raise if no stable filter exists."""
    words = (
        "(A, C) must be detectable; the mode of A at {mode} does not decay and no measurement sees "
        "it. Measure it, or take it out of the model."
    )
    require_seen(problem.A, problem.C, words, drive=problem.B)
    A_s, B_s, _ = decorrelate(problem)
    words = (
        "every mode on the unit circle must be driven by noise; the mode of A at {mode} is not, so "
        "the filter would stop correcting it. Add a column to B."
    )
    require_seen(A_s.T, B_s.T, words, drive=problem.C.T, only_unit_circle=True)


@lru_cache(maxsize=2)
def kalman_riccati(problem: EstimationProblem) -> FilterRiccati:
    """Solve ``P = A P A' + Q - (A P C' + S)(R + C P C')^-1 (C P A' + S')``, for all phases."""
    scaled, units = _in_noise_units(problem)
    constant = _over_a_period(scaled)
    require_detectable(constant)
    dare = solve_dare(constant.A.T, constant.C.T, constant.Q, constant.R, constant.S)
    covariances = dare.X[None] if problem.period == 1 else _settle_phases(scaled, dare.X)
    gains = np.stack([kalman_gain(scaled, t, P) for t, P in enumerate(covariances)])
    if problem.period == 1:
        gains[0][:, problem.read[0]] = dare.gain_feedback.T  # refined in extended precision
    return _filter_of(covariances, gains / units, dare.iterations, dare.route)


def _in_noise_units(problem: EstimationProblem) -> tuple[EstimationProblem, FloatArray]:
    """Return the problem in units (q,) of the noise of its measurements, powers of two."""
    D = as_stack(problem.D) * problem.read[:, :, None]
    units = nearest_powers_of_two(np.linalg.norm(D, axis=-1).max(axis=0))
    return problem.bare(C=problem.C / units[:, None], D=problem.D / units[:, None]), units


def _over_a_period(problem: EstimationProblem) -> EstimationProblem:
    """Return the constant problem whose Kalman recursion over a sample is that over a period."""
    if problem.period == 1:
        A, B, C, D = problem.read_parts(0)
        return problem.bare(A=A, B=B, C=C, D=D, read=None)
    triples = (_kalman_triple(problem, t) for t in range(problem.period))
    A, G, H = reduce(_join_triples, triples)
    zero, identity = np.zeros_like(A), np.eye(len(A))
    B, D = np.hstack([weight_root(H), zero]), np.hstack([zero, identity])
    return EstimationProblem(A=A, B=B, C=weight_root(G).T, D=D, L=identity)


def _filter_of(P: FloatArray, gains: FloatArray, iterations: int, status: str) -> FilterRiccati:
    """Return the solution of P (N, n, n) and gains (N, n, q), whose only phase is squeezed."""
    phases = 0 if len(P) == 1 else slice(None)
    return FilterRiccati(
        P=frozen_copy(P[phases]),
        gain_predictor=frozen_copy(gains[phases]),
        iterations=iterations,
        status=status,
    )


def _settle_phases(problem: EstimationProblem, P: FloatArray) -> FloatArray:
    """Return the covariances (N, n, n) of a sweep in Joseph's form and of Newton steps."""
    covariances = np.empty_like(problem.A)
    for t in range(problem.period):
        covariances[t] = P
        gain = kalman_gain(problem, t, P)
        error, drive = problem.A[t] - gain @ problem.C[t], problem.B[t] - gain @ problem.D[t]
        P = symmetrise(error @ P @ error.T + drive @ drive.T)
    change, last = 1.0, np.inf
    while 0 < change < last / 2:
        gains = np.stack([kalman_gain(problem, t, P) for t, P in enumerate(covariances)])
        error_system = problem.error_system(gains)
        if not error_system.spectral_radius < 1:
            change = np.inf
            break
        refined = error_system.covariances()
        last, change = change, relative_distance(covariances, refined)
        covariances = refined
    if change > ERROR_LIMIT:
        raise NumericalError(
            f"the periodic Riccati equation was solved only to a relative {change:.3g}; expected "
            f"{ERROR_LIMIT:g}. Scale the states to similar sizes.",
            status="residual",
            residual=change,
        )
    return covariances


def _join_triples(first: _Triple, then: _Triple) -> _Triple:
    """Return the triple of two samples of the recursion, one after the other."""
    (A1, G1, H1), (A2, G2, H2) = first, then
    identity = np.eye(len(A1))
    onward = A2 @ np.linalg.solve(identity + H1 @ G2, identity)
    information = np.linalg.solve(identity + G2 @ H1, G2) @ A1
    return onward @ A1, symmetrise(G1 + A1.T @ information), symmetrise(H2 + onward @ H1 @ A2.T)


def _kalman_triple(problem: EstimationProblem, t: int) -> _Triple:
    """Return one sample of the Kalman recursion, with process and measurement noise separated."""
    _, _, C, D = problem.read_parts(t)
    A, B, _ = decorrelate(problem, t)
    return A, symmetrise(C.T @ np.linalg.solve(D @ D.T, C)), B @ B.T


def kalman_gain(problem: EstimationProblem, t: int, P: FloatArray) -> FloatArray:
    """Return the gain of the predictor (n, q) at a phase, for its covariance P."""
    A, B, C, D = problem.read_parts(t)
    innovation = C @ P @ C.T + D @ D.T
    out = np.zeros((problem.n_states, problem.n_measurements))
    rows = problem.read[t % problem.period]
    out[:, rows] = np.linalg.solve(innovation, (A @ P @ C.T + B @ D.T).T).T
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelTrial:
    """Whether one level can be met, and the solution of its equation if so."""

    slack: float  # least eigenvalue of ``I - L P L' / gamma^2``; negative if it cannot be met
    P: FloatArray | None = None  # (N, n, n), in the units of the equation
    residual: float = 0.0  # relative change of P over a period
    iterations: int = 0  # doublings


class GammaEquation:
    """``P = A P (I + W P)^-1 A' + BB'``, ``W = C'R^-1 C - L'L / gamma^2``, for any gamma.

    A predictor with an error norm below gamma exists if and only if the
    stabilising P is positive semidefinite and ``gamma^2 I - L P L' > 0``; the gain
    is ``A Pt C'(R + C Pt C')^-1`` with ``Pt = P + P L'(gamma^2 I - L P L')^-1 L P``.
    Noise is decorrelated first.

    The equation is solved for the excess over the Kalman filter's P0. With the
    filtered covariance M, F = I - gain_filter C and
    ``N = I + M L'(gamma^2 I - L M L')^-1 L``::

        P = P0 + X,   X = A1 X (I + G1 X)^-1 A1' + H1
        A1 = A N F,   G1 = W N F,   H1 = A M L'(gamma^2 I - L M L')^-1 L M A'

    H1 is positive semidefinite and holds no difference of large numbers, so the
    doubling starts inside the stabilising solution's reach. The states are in units in which
    the Kalman errors have size one, the measurements in those of their noise.
    """

    def __init__(self, problem: EstimationProblem, start: FilterRiccati) -> None:
        covariances = as_stack(start.P)
        self.units = error_units(covariances)
        scaled, self.noise_units = _in_noise_units(problem)
        self.problem = scale_states(scaled, self.units)
        self.least = covariances / self.units / self.units.T
        self.samples = []  # A, filtered covariance, F and C'R^-1 C of each phase
        for t, P in enumerate(self.least):
            A, information, _ = _kalman_triple(self.problem, t)
            _, _, C, D = self.problem.read_parts(t)
            gain_filter = np.linalg.solve(C @ P @ C.T + D @ D.T, C @ P).T
            keep = np.eye(len(A)) - gain_filter @ C
            self.samples.append((A, symmetrise(keep @ P), keep, information))

    def trial(self, gamma: float) -> LevelTrial:
        """Solve at one level, to the accuracy of the doubling."""
        L, identity = self.problem.L, np.eye(self.problem.n_states)
        triples = []
        for A, filtered, keep, information in self.samples:
            seen = L @ filtered
            room = np.eye(len(L)) - seen @ L.T / gamma**2
            if np.linalg.eigvalsh(room)[0] <= 0:
                return LevelTrial(slack=-1.0)
            spread = np.linalg.solve(room, L) / gamma**2
            widened = (identity + seen.T @ spread) @ keep
            G1 = (information - L.T @ L / gamma**2) @ widened
            H1 = A @ (seen.T @ spread @ filtered) @ A.T
            triples.append((A @ widened, symmetrise(G1), symmetrise(H1)))
        A, G, H = reduce(_join_triples, triples)
        excess, steps = doubling(A.T[None], G[None], H[None])
        X, transition, slack = excess[0], identity, np.inf
        P = np.empty_like(self.least)
        for t, (A1, G1, H1) in enumerate(triples):
            if not np.isfinite(X).all():
                return LevelTrial(slack=-1.0)
            spectrum = np.linalg.eigvalsh(X)
            if spectrum[0] < -_INDEFINITE * abs(spectrum[-1]):
                return LevelTrial(slack=-1.0)
            P[t] = self.least[t] + X
            slack = min(slack, 1 - float(np.linalg.eigvalsh(L @ P[t] @ L.T)[-1]) / gamma**2)
            onward = np.linalg.solve((identity + X @ G1).T, A1.T).T  # A (I + P W)^-1
            transition = onward @ transition
            X = symmetrise(onward @ X @ A1.T + H1)
        if not np.max(np.abs(np.linalg.eigvals(transition))) < 1:
            return LevelTrial(slack=-1.0)
        residual = relative_distance(self.least[0] + X, P[0])
        if slack <= 0:
            return LevelTrial(slack=slack)
        return LevelTrial(slack=slack, P=P, residual=residual, iterations=steps)

    def solution(self, gamma: float, trial: LevelTrial) -> FilterRiccati | None:
        """Refine a trial and form its gains; None if it is no filter."""
        if trial.P is None:
            return None
        problem, P, residual = self.problem, trial.P, trial.residual
        if problem.period == 1:
            P, residual = self._refined(gamma, P)
        if residual > _RESIDUAL_LIMIT:
            raise NumericalError(
                f"the gamma-Riccati equation at gamma = {gamma:.9g} was solved only to a relative "
                f"residual of {residual:.3g}; expected {_RESIDUAL_LIMIT:g}. Try route='lmi', or "
                "scale the states to similar sizes.",
                status="residual",
                residual=residual,
            )
        gains = np.stack([_central_gain(problem, t, gamma, p) for t, p in enumerate(P)])
        if not problem.error_system(gains).spectral_radius < 1:
            return None
        gains = self.units * gains / self.noise_units
        covariances = self.units * P * self.units.T
        return _filter_of(covariances, gains, trial.iterations, "doubling")

    def _refined(self, gamma: float, P: FloatArray) -> tuple[FloatArray, float]:
        """Return the solution of one phase after Newton steps, (1, n, n), and its residual."""
        _, _, C, D = self.problem.read_parts(0)
        A, B, _ = decorrelate(self.problem)
        outputs = np.vstack([C, self.problem.L / gamma])
        equation = Equations(
            A=A.T[None],
            B=outputs.T[None],
            Q=(B @ B.T)[None],
            R=block_diag(D @ D.T, -np.eye(len(self.problem.L)))[None],
            S=np.zeros((1, len(A), len(outputs))),
        )
        refined = equation.refine(P)
        return refined.X, float(refined.residuals[0])


def _central_gain(problem: EstimationProblem, t: int, gamma: float, P: FloatArray) -> FloatArray:
    """Return the predictor's gain (n, q) of the central filter at a phase."""
    _, _, C, D = problem.read_parts(t)
    A, _, injection = decorrelate(problem, t)
    outputs = np.vstack([C, problem.L / gamma])
    innovations = outputs @ P @ outputs.T + block_diag(D @ D.T, -np.eye(len(problem.L)))
    # the first block column of P outputs' innovations^-1: Pt itself may be unbounded
    gain_filter = np.linalg.solve(innovations, outputs @ P)[: len(C)].T
    out = np.zeros((problem.n_states, problem.n_measurements))
    out[:, problem.read[t % problem.period]] = A @ gain_filter + injection
    return out


def gamma_riccati(
    problem: EstimationProblem, gamma: float, *, start: FilterRiccati | None = None
) -> FilterRiccati | None:
    """Return the central H-infinity predictor of a level of gamma; None where there is none."""
    start = kalman_riccati(problem) if start is None else start
    equation = GammaEquation(problem, start)
    return equation.solution(gamma, equation.trial(gamma))


def least_gamma(
    problem: EstimationProblem, *, lower: float, upper: float, start: FilterRiccati | None = None
) -> tuple[float, float, FilterRiccati]:
    """Bracket the least gamma, at which ``gamma^2 I - L P L'`` stops being positive.

    Returns the ends of the bracket, and the filter at the upper one. The bracket is 1e-11 wide,
    relative.
    """
    equation = GammaEquation(problem, kalman_riccati(problem) if start is None else start)
    errors = (equation.problem.L @ P @ equation.problem.L.T for P in equation.least)
    # no filter has less than the Kalman filter's variance, the mean square over all frequencies
    lower = max(lower, *(float(np.sqrt(np.linalg.eigvalsh(error)[-1])) for error in errors))
    met: dict[float, LevelTrial] = {}

    def slack(gamma: float) -> float:
        nonlocal lower
        trial = equation.trial(gamma)
        if trial.P is None:
            lower = max(lower, gamma)
            return min(trial.slack, -_GAMMA_TOLERANCE)  # at a slack of 0 there is no filter
        met[gamma] = trial
        return trial.slack

    for _ in range(60):  # the upper level is feasible in exact arithmetic
        if slack(upper) > 0:
            break
        upper *= 1.0001 if upper < 1.01 * lower else 1.01
    if not met:
        raise InfeasibleError(
            f"no gamma up to {upper:.6g} has an H-infinity filter; expected one at the level of "
            "the Kalman filter. Scale the states to similar sizes.",
            gamma=upper,
        )
    highest = upper

    @cache
    def slack_at(s: float) -> float:
        """Return the slack, which is almost linear in ``s = (highest / gamma)^2``."""
        return slack(highest * s**-0.5)

    lowest = (upper / lower) ** 2
    if lowest > 1 and slack_at(lowest) <= 0:
        brentq(slack_at, lowest, 1.0, xtol=2 * _GAMMA_TOLERANCE)  # its steps are half of it
    for gamma in sorted(met):  # a level too close to the edge may give no filter
        solution = equation.solution(gamma, met[gamma])
        if solution is not None:
            return lower, gamma, solution
    raise NumericalError(
        f"the least gamma was not bracketed: it lies between {lower:.9g} and {min(met):.9g}.",
        status="search",
    )
