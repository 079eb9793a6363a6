"""The periodic Riccati equations of the Kalman and the H-infinity filter, by cyclic doubling.

One sample of the recursion ``P+ = A P (I + G P)^-1 A' + H`` is the triple (A, G, H). The triples
of a period are joined into one, whose fixed point is found by structured doubling; a sweep through
the period then gives the solution of every phase. Nothing grows with the period but the time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem, error_units, scale_states
from lbt_synth.linear.infeasibility_proof import infeasible_periodic_level, worst_invisible_bursts
from lbt_synth.linear.matrix_functions import is_stable, relative_distance, symmetrise
from lbt_synth.linear.periodic.problem import PeriodicProblem
from lbt_synth.linear.riccati.filtering import require_detectable
from lbt_synth.linear.riccati.routes import doubling
from lbt_synth.linear.riccati.solvability import weight_root
from lbt_synth.validation import FloatArray, frozen_copy

_NEWTON_STEPS = 6
_SETTLED = 1e-13  # relative change of a Newton step at which no further is made
_CLOSED = 1e-6  # and that of the last, beyond which the solution is refused
_GAMMA_TOLERANCE = 1e-9

Triple = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PeriodicRiccati:
    """Solution of a periodic filter equation."""

    # (N, n, n): covariance of the prediction error at each phase (Kalman), or its H-infinity
    # counterpart
    P: FloatArray
    gains: FloatArray  # (N, n, q): predictor gains; zero for measurements that are not read
    residual: float  # relative change of P in the last Newton step
    steps: int  # Newton steps made after the doubling, each a Lyapunov equation


def join_triples(first: Triple, then: Triple) -> Triple:
    """Return the triple of two samples of the recursion, one after the other."""
    (A1, G1, H1), (A2, G2, H2) = first, then
    identity = np.eye(len(A1))
    left = A2 @ np.linalg.solve(identity + H1 @ G2, identity)
    right = np.linalg.solve(identity + G2 @ H1, G2) @ A1
    return left @ A1, symmetrise(G1 + A1.T @ right), symmetrise(H2 + left @ H1 @ A2.T)


def fixed_point(triple: Triple) -> FloatArray:
    """Return the stabilising solution of the recursion of a triple; nan if there is none."""
    A, G, H = triple
    with np.errstate(all="ignore"):
        return np.asarray(doubling(A.T[None], G[None], H[None])[0][0])


def periodic_kalman(problem: PeriodicProblem) -> PeriodicRiccati:
    """Solve the periodic Riccati equation of the Kalman predictor.

    Parameters
    ----------
    problem : PeriodicProblem
        The problem.

    Returns
    -------
    PeriodicRiccati
        Covariances and predictor gains of every phase.

    Raises
    ------
    DetectabilityError
        If no stable filter exists; the message names the mode of a period.
    NumericalError
        If the equation was not solved.

    Examples
    --------
    >>> from lbt_synth.linear.periodic.problem import PeriodicProblem
    >>> from lbt_synth.linear.periodic.riccati import periodic_kalman
    >>> walk = PeriodicProblem(
    ...     A=[[[1.0]]], B=[[[1.0, 0.0]]], C=[[[1.0]]], D=[[[0.0, 1.0]]], L=[[1.0]], read=[[True]]
    ... )
    >>> round(float(periodic_kalman(walk).P[0, 0, 0]), 9)
    1.618033989
    """
    whole = reduce(join_triples, (_kalman_triple(problem, t) for t in range(problem.period)))
    require_detectable(_problem_of_triple(whole))
    P = fixed_point(whole)
    if not np.isfinite(P).all():
        raise NumericalError(
            "the periodic Riccati equation was not solved: the doubling did not converge. Scale "
            "the states to similar sizes.",
            status="doubling",
        )
    covariances, change, steps = _sweep(problem, P), np.inf, 0
    gains = np.zeros((problem.period, problem.n_states, problem.n_measurements))
    while steps < _NEWTON_STEPS:
        gains = np.stack([kalman_gain(problem, t, P) for t, P in enumerate(covariances)])
        error = problem.error_system(gains)
        if not error.spectral_radius < 1:
            break
        refined = error.covariances()
        last, change = change, relative_distance(covariances, refined)
        covariances, steps = refined, steps + 1
        if change < _SETTLED or change > last / 2:
            break
    if change > _CLOSED:
        raise NumericalError(
            f"the periodic Riccati equation was solved only to a relative {change:.3g}; expected "
            f"{_CLOSED:g}. Scale the states to similar sizes.",
            status="residual",
            residual=change,
        )
    return PeriodicRiccati(
        P=frozen_copy(covariances), gains=frozen_copy(gains), residual=change, steps=steps
    )


def _sweep(problem: PeriodicProblem, P: FloatArray) -> FloatArray:
    """Return the covariances of all phases from that of phase 0, (N, n, n), in Joseph's form."""
    out = np.empty_like(problem.A)
    for t in range(problem.period):
        out[t] = P
        gain = kalman_gain(problem, t, P)
        error, drive = problem.A[t] - gain @ problem.C[t], problem.B[t] - gain @ problem.D[t]
        P = symmetrise(error @ P @ error.T + drive @ drive.T)
    return out


def kalman_gain(problem: PeriodicProblem, t: int, P: FloatArray) -> FloatArray:
    """Return the predictor gain (n, q) of a phase for the covariance of its prediction error."""
    A, B, C, D = problem.parts(t)
    gain = np.zeros((problem.n_states, problem.n_measurements))
    if len(C):
        innovation = C @ P @ C.T + D @ D.T
        gain[:, problem.read[t]] = np.linalg.solve(innovation, (A @ P @ C.T + B @ D.T).T).T
    return gain


def _kalman_triple(problem: PeriodicProblem, t: int) -> Triple:
    """Return one sample of the Kalman recursion, with process and measurement noise separated."""
    A, B, C, D = problem.parts(t)
    if len(C) == 0:
        return A, np.zeros_like(A), B @ B.T
    R = D @ D.T
    injection = np.linalg.solve(R, D @ B.T).T
    A_s, B_s = A - injection @ C, B - injection @ D
    return A_s, symmetrise(C.T @ np.linalg.solve(R, C)), B_s @ B_s.T


def _problem_of_triple(triple: Triple) -> EstimationProblem:
    """Return a problem of one rate whose Kalman recursion is that of a triple."""
    A, G, H = triple
    zero, identity = np.zeros_like(A), np.eye(len(A))
    B, D = np.hstack([weight_root(H), zero]), np.hstack([zero, identity])
    return EstimationProblem(A=A, B=B, C=weight_root(G).T, D=D, L=identity)


def periodic_hinf(
    problem: PeriodicProblem, gamma: float, start: PeriodicRiccati
) -> PeriodicRiccati | None:
    """Solve the gamma-Riccati equation of the central H-infinity predictor of a level.

    As for a filter of one rate, the excess over the Kalman filter's covariance is solved for (see
    ``riccati.filtering.GammaEquation``), phase by phase, from the Kalman filter's solution. None
    where no filter meets the level, of the norm of the error over all samples.
    """
    triples = []
    for t in range(problem.period):
        triple = _excess_triple(problem, t, gamma, start.P[t])
        if triple is None:
            return None
        triples.append(triple)
    X = fixed_point(reduce(join_triples, triples))
    L, identity = problem.L, np.eye(problem.n_states)
    P, gains = np.empty_like(problem.A), np.zeros_like(start.gains)
    transition = identity
    for t, (A1, G1, H1) in enumerate(triples):
        if not np.isfinite(X).all():
            return None
        spectrum = np.linalg.eigvalsh(X)
        P[t] = start.P[t] + X
        slack = 1 - float(np.linalg.eigvalsh(L @ P[t] @ L.T)[-1]) / gamma**2
        if spectrum[0] < -1e-9 * abs(spectrum[-1]) or slack <= 0:
            return None
        gains[t] = _central_gain(problem, t, gamma, P[t])
        onward = np.linalg.solve((identity + X @ G1).T, A1.T).T
        transition = onward @ transition
        X = symmetrise(onward @ X @ A1.T + H1)
    if not is_stable(transition) or not problem.error_system(gains).spectral_radius < 1:
        return None
    residual = relative_distance(start.P[0] + X, P[0])
    return PeriodicRiccati(P=frozen_copy(P), gains=frozen_copy(gains), residual=residual, steps=0)


def _excess_triple(problem: PeriodicProblem, t: int, gamma: float, P: FloatArray) -> Triple | None:
    """Return one sample of the recursion of the excess over the Kalman covariance.

    None where the level is not met even by the filtered estimate.
    """
    L, (A, information, _) = problem.L, _kalman_triple(problem, t)
    keep = np.linalg.solve(np.eye(len(A)) + P @ information, np.eye(len(A)))
    filtered = symmetrise(keep @ P)
    seen = L @ filtered
    room = np.eye(len(L)) - seen @ L.T / gamma**2
    if np.linalg.eigvalsh(room)[0] <= 0:
        return None
    spread = np.linalg.solve(room, L) / gamma**2
    widened = (np.eye(len(A)) + seen.T @ spread) @ keep
    A1, G1 = A @ widened, (information - L.T @ L / gamma**2) @ widened
    H1 = A @ (seen.T @ spread @ filtered) @ A.T
    return A1, symmetrise(G1), symmetrise(H1)


def _central_gain(problem: PeriodicProblem, t: int, gamma: float, P: FloatArray) -> FloatArray:
    """Predictor gain (n, q) of the central filter at a phase."""
    A, B, C, D = problem.parts(t)
    gain = np.zeros((problem.n_states, problem.n_measurements))
    if len(C) == 0:
        return gain
    R = D @ D.T
    injection = np.linalg.solve(R, D @ B.T).T
    outputs = np.vstack([C, problem.L / gamma])
    innovations = outputs @ P @ outputs.T
    innovations[: len(C), : len(C)] += R
    innovations[len(C) :, len(C) :] -= np.eye(len(problem.L))
    own = np.linalg.solve(innovations, outputs @ P)[: len(C)].T
    gain[:, problem.read[t]] = (A - injection @ C) @ own + injection
    return gain


def proved_periodic_gamma(problem: PeriodicProblem, start: PeriodicRiccati, level: float) -> float:
    """Return a level of gamma that no filter reaches, proved by disturbances that none can see.

    The worst of a level that is met, next to the least one; 0 if the equation does not meet it.
    """
    met = periodic_hinf(problem, level, start)
    if met is None:
        return 0.0
    units = error_units(start.P.max(axis=0))
    both = units * units.T
    phases = [scale_states(problem.phase(t), units) for t in range(problem.period)]
    bursts = worst_invisible_bursts(phases, list(met.P / both), level)
    return infeasible_periodic_level(phases, bursts, list(start.P / both))


def least_periodic_gamma(problem: PeriodicProblem, start: PeriodicRiccati, upper: float) -> float:
    """Return the least gamma that the equation meets, to 1e-9.

    ``upper`` is a level that is met, such as the norm of the Kalman filter's error.
    """
    lower = float(
        np.sqrt(max(np.linalg.eigvalsh(problem.L @ P @ problem.L.T)[-1] for P in start.P))
    )
    for _ in range(60):  # met in exact arithmetic
        if periodic_hinf(problem, upper, start) is not None:
            break
        upper *= 1.001
    else:
        raise InfeasibleError(
            f"no gamma up to {upper:.6g} has a periodic H-infinity filter; expected one at the "
            "level of the Kalman filter. Scale the states to similar sizes.",
            gamma=upper,
        )
    lower = min(lower, upper)
    while upper - lower > _GAMMA_TOLERANCE * upper:
        middle = (lower + upper) / 2
        if periodic_hinf(problem, middle, start) is None:
            lower = middle
        else:
            upper = middle
    return upper
