"""The periodic Riccati equations of the Kalman and the H-infinity filter, by cyclic doubling.

One sample of the recursion ``P+ = A P (I + G P)^-1 A' + H`` is the triple (A, G, H). The triples
of a period are joined into one, whose fixed point is found by structured doubling; a sweep through
the period then gives the solution of every phase. Nothing grows with the period but the time.
"""

from __future__ import annotations

from functools import reduce

import numpy as np

from lbt_synth.errors import InfeasibleError, NumericalError
from lbt_synth.linear.estimation_problem import EstimationProblem, decorrelate
from lbt_synth.linear.matrix_functions import is_stable, relative_distance, symmetrise
from lbt_synth.linear.riccati.filtering import FilterRiccati, kalman_gains, require_detectable
from lbt_synth.linear.riccati.routes import doubling
from lbt_synth.linear.riccati.solvability import weight_root
from lbt_synth.validation import FloatArray, frozen_copy

_NEWTON_STEPS = 6
_SETTLED = 1e-13  # relative change of a Newton step at which no further is made
_CLOSED = 1e-6  # and that of the last, beyond which the solution is refused
_GAMMA_TOLERANCE = 1e-9

Triple = tuple[FloatArray, FloatArray, FloatArray]


def _join_triples(first: Triple, then: Triple) -> Triple:
    """Return the triple of two samples of the recursion, one after the other."""
    (A1, G1, H1), (A2, G2, H2) = first, then
    identity = np.eye(len(A1))
    left = A2 @ np.linalg.solve(identity + H1 @ G2, identity)
    right = np.linalg.solve(identity + G2 @ H1, G2) @ A1
    return left @ A1, symmetrise(G1 + A1.T @ right), symmetrise(H2 + left @ H1 @ A2.T)


def _fixed_point(triple: Triple) -> FloatArray:
    """Return the stabilising solution of the recursion of a triple; nan if there is none."""
    A, G, H = triple
    with np.errstate(all="ignore"):
        return np.asarray(doubling(A.T[None], G[None], H[None])[0][0])


def periodic_kalman(problem: EstimationProblem) -> FilterRiccati:
    """Solve the equation of the Kalman predictor, as ``kalman_riccati`` of any period does."""
    whole = reduce(_join_triples, (_kalman_triple(problem, t) for t in range(problem.period)))
    require_detectable(_problem_of_triple(whole))
    P = _fixed_point(whole)
    if not np.isfinite(P).all():
        raise NumericalError(
            "the periodic Riccati equation was not solved: the doubling did not converge. Scale "
            "the states to similar sizes.",
            status="doubling",
        )
    covariances, change, steps = _sweep(problem, P), np.inf, 0
    gains = np.zeros((2, problem.period, problem.n_states, problem.n_measurements))
    while steps < _NEWTON_STEPS:
        for t, P in enumerate(covariances):
            gains[:, t] = kalman_gains(problem, t, P)
        error = problem.error_system(gains[0])
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
    return _solution(covariances, gains, change, steps)


def _solution(P: FloatArray, gains: FloatArray, residual: float, steps: int) -> FilterRiccati:
    """Return the solution of gains of predictor and filter, (2, N, n, q)."""
    return FilterRiccati(
        P=frozen_copy(P),
        gain_predictor=frozen_copy(gains[0]),
        gain_filter=frozen_copy(gains[1]),
        residual=residual,
        iterations=steps,
        status="cyclic doubling",
    )


def _sweep(problem: EstimationProblem, P: FloatArray) -> FloatArray:
    """Return the covariances of all phases from that of phase 0, (N, n, n), in Joseph's form."""
    out = np.empty_like(problem.A)
    for t in range(problem.period):
        out[t] = P
        gain = kalman_gains(problem, t, P)[0]
        error, drive = problem.A[t] - gain @ problem.C[t], problem.B[t] - gain @ problem.D[t]
        P = symmetrise(error @ P @ error.T + drive @ drive.T)
    return out


def _kalman_triple(problem: EstimationProblem, t: int) -> Triple:
    """Return one sample of the Kalman recursion, with process and measurement noise separated."""
    _, _, C, D = problem.read_parts(t)
    A, B, _ = decorrelate(problem, t)
    return A, symmetrise(C.T @ np.linalg.solve(D @ D.T, C)), B @ B.T


def _problem_of_triple(triple: Triple) -> EstimationProblem:
    """Return a problem of one rate whose Kalman recursion is that of a triple."""
    A, G, H = triple
    zero, identity = np.zeros_like(A), np.eye(len(A))
    B, D = np.hstack([weight_root(H), zero]), np.hstack([zero, identity])
    return EstimationProblem(A=A, B=B, C=weight_root(G).T, D=D, L=identity)


def periodic_hinf(
    problem: EstimationProblem, gamma: float, start: FilterRiccati
) -> FilterRiccati | None:
    """Solve the gamma-Riccati equation of the central H-infinity predictor of a level.

    As with a period of 1, the excess over the Kalman filter's covariance is solved for (see
    ``GammaEquation``), phase by phase, from the Kalman filter's solution. None where no filter
    meets the level, of the norm of the error over all samples.
    """
    triples = []
    for t in range(problem.period):
        triple = _excess_triple(problem, t, gamma, start.P[t])
        if triple is None:
            return None
        triples.append(triple)
    X = _fixed_point(reduce(_join_triples, triples))
    L, identity = problem.L, np.eye(problem.n_states)
    P, gains = np.empty_like(problem.A), np.zeros((2, *start.gain_predictor.shape))
    transition = identity
    for t, (A1, G1, H1) in enumerate(triples):
        if not np.isfinite(X).all():
            return None
        spectrum = np.linalg.eigvalsh(X)
        P[t] = start.P[t] + X
        slack = 1 - float(np.linalg.eigvalsh(L @ P[t] @ L.T)[-1]) / gamma**2
        if spectrum[0] < -1e-9 * abs(spectrum[-1]) or slack <= 0:
            return None
        gains[:, t] = _central_gains(problem, t, gamma, P[t])
        onward = np.linalg.solve((identity + X @ G1).T, A1.T).T
        transition = onward @ transition
        X = symmetrise(onward @ X @ A1.T + H1)
    if not is_stable(transition) or not problem.error_system(gains[0]).spectral_radius < 1:
        return None
    return _solution(P, gains, relative_distance(start.P[0] + X, P[0]), 0)


def _excess_triple(
    problem: EstimationProblem, t: int, gamma: float, P: FloatArray
) -> Triple | None:
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


def _central_gains(problem: EstimationProblem, t: int, gamma: float, P: FloatArray) -> FloatArray:
    """Return the gains of predictor and filter (2, n, q) of the central filter at a phase."""
    _, _, C, D = problem.read_parts(t)
    A, _, injection = decorrelate(problem, t)
    outputs = np.vstack([C, problem.L / gamma])
    innovations = outputs @ P @ outputs.T
    innovations[: len(C), : len(C)] += D @ D.T
    innovations[len(C) :, len(C) :] -= np.eye(len(problem.L))
    gain_filter = np.linalg.solve(innovations, outputs @ P)[: len(C)].T
    out = np.zeros((2, problem.n_states, problem.n_measurements))
    rows = problem.read[t % problem.period]
    out[0][:, rows], out[1][:, rows] = A @ gain_filter + injection, gain_filter
    return out


def least_periodic_gamma(
    problem: EstimationProblem, lower: float, upper: float, start: FilterRiccati
) -> tuple[float, float, FilterRiccati]:
    """Bracket the least gamma that the equation meets to 1e-9; return also the filter there.

    The upper level is one that is met, such as the norm of the Kalman filter's error.
    """
    powers = (np.linalg.eigvalsh(problem.L @ P @ problem.L.T)[-1] for P in start.P)
    lower = max(lower, float(np.sqrt(max(*powers, 0.0))))
    for _ in range(60):  # met in exact arithmetic
        solution = periodic_hinf(problem, upper, start)
        if solution is not None:
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
        trial = periodic_hinf(problem, middle, start)
        if trial is None:
            lower = middle
        else:
            upper, solution = middle, trial
    return lower, upper, solution
