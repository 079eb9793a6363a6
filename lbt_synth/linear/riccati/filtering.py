"""Solve the Riccati equations of the Kalman and the H-infinity predictor; find the least gamma.

Measurements that are not read are left out, and have no gain. Problems with a longer period are
solved in :mod:`lbt_synth.linear.riccati.periodic`.

B. Hassibi, A. H. Sayed, T. Kailath, "Indefinite-Quadratic Estimation and
Control", SIAM (1999), doi:10.1137/1.9781611970760, chapter 4 (a-priori filter).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import brentq

from lbt_synth.errors import DetectabilityError, InfeasibleError, NumericalError
from lbt_synth.linear.estimation_problem import (
    EstimationProblem,
    decorrelate,
    error_units,
    scale_states,
)
from lbt_synth.linear.matrix_functions import is_stable, nearest_powers_of_two
from lbt_synth.linear.riccati.dare import solve_dare
from lbt_synth.linear.riccati.equations import Equations
from lbt_synth.linear.riccati.routes import doubling
from lbt_synth.linear.riccati.solvability import unstable_hidden_mode
from lbt_synth.validation import FloatArray, frozen_copy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterRiccati:
    """A solved filter equation; with a longer period its matrices have an axis of phases."""

    # (n, n) or (N, n, n): covariance of the prediction error (Kalman), or its H-infinity
    # counterpart
    P: FloatArray
    # (n, q) or (N, n, q): gains of the measurement and the time update together, and of the
    # measurement update alone; zero for what is not read
    gain_predictor: FloatArray
    gain_filter: FloatArray
    # relative residual of the equation; with a longer period, relative change of P in the last
    # step, or over a period
    residual: float
    iterations: int  # number of doublings; with a longer period, of Newton steps after them
    status: str  # the route that gave P


def require_detectable(problem: EstimationProblem) -> None:
    """Raise if no stable filter exists."""
    hidden = unstable_hidden_mode(problem.A, problem.C, drive=problem.B)
    if hidden is not None:
        raise DetectabilityError(
            f"(A, C) must be detectable; the mode of A at {hidden:.6g} does not decay and no "
            "measurement sees it. Measure it, or take it out of the model.",
            eigenvalue=hidden,
        )
    A_s, B_s, _ = decorrelate(problem)
    hidden = unstable_hidden_mode(A_s.T, B_s.T, drive=problem.C.T, only_unit_circle=True)
    if hidden is not None:
        raise DetectabilityError(
            f"every mode on the unit circle must be driven by noise; the mode of A at "
            f"{hidden:.6g} is not, so the filter would stop correcting it. Add a column to B.",
            eigenvalue=hidden,
        )


def kalman_riccati(problem: EstimationProblem) -> FilterRiccati:
    """Solve ``P = A P A' + Q - (A P C' + S)(R + C P C')^-1 (C P A' + S')``, for all phases.

    ``lbt_synth.design.kalman`` returns the same filter as a certified design.

    Parameters
    ----------
    problem : EstimationProblem
        The problem.

    Returns
    -------
    FilterRiccati
        The stabilising solution and its gains.

    Raises
    ------
    DetectabilityError
        If there is no stabilising solution.
    NumericalError
        If the equation was not solved.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> round(float(lbt.linear.kalman_riccati(p).P[0, 0]), 12)
    1.61803398875
    """
    if problem.period > 1:
        from lbt_synth.linear.riccati.periodic import periodic_kalman

        return periodic_kalman(problem)
    part = ReadPart(problem)
    if not part.is_whole:
        return part.scatter(kalman_riccati(part.problem))
    require_detectable(problem)
    dare = solve_dare(problem.A.T, problem.C.T, problem.Q, problem.R, problem.S)
    innovation = problem.R + problem.C @ dare.X @ problem.C.T
    gain_filter = np.linalg.solve(innovation, problem.C @ dare.X).T
    return FilterRiccati(
        P=dare.X,
        gain_predictor=frozen_copy(dare.gain_feedback.T),
        gain_filter=frozen_copy(gain_filter),
        residual=dare.residual,
        iterations=dare.iterations,
        status=dare.route,
    )


def kalman_gains(problem: EstimationProblem, t: int, P: FloatArray) -> FloatArray:
    """Return the gains of predictor and filter (2, n, q) at a phase, for their covariance P."""
    A, B, C, D = problem.read_parts(t)
    innovation = C @ P @ C.T + D @ D.T
    out = np.zeros((2, problem.n_states, problem.n_measurements))
    rows = problem.read[t % problem.period]
    out[0][:, rows] = np.linalg.solve(innovation, (A @ P @ C.T + B @ D.T).T).T
    out[1][:, rows] = np.linalg.solve(innovation, C @ P).T
    return out


_ALIKE = 1e4  # ratio of the noise of measurements up to which they keep their units


class ReadPart:
    """The measurements of a problem that are read, in units of their noise if these differ much."""

    def __init__(self, problem: EstimationProblem) -> None:
        A, B, C, D = problem.read_parts(0)
        self.rows = problem.read[0]
        sizes = np.linalg.norm(D, axis=1)
        alike = sizes.max() <= _ALIKE * sizes.min()
        self.units = np.ones(len(D)) if alike else nearest_powers_of_two(sizes)
        self.is_whole = bool(alike and self.rows.all())
        self.problem = problem
        if not self.is_whole:
            C, D = (part / self.units[:, None] for part in (C, D))
            self.problem = EstimationProblem(A=A, B=B, C=C, D=D, L=problem.L, dt_s=problem.dt_s)

    def gather(self, solution: FilterRiccati) -> FilterRiccati:
        """Return a solution of the whole problem as one of the part."""
        if self.is_whole:
            return solution
        predictor, filtering = solution.gain_predictor, solution.gain_filter
        predictor, filtering = (gain[:, self.rows] * self.units for gain in (predictor, filtering))
        return replace(solution, gain_predictor=predictor, gain_filter=filtering)

    def scatter(self, solution: FilterRiccati) -> FilterRiccati:
        """Return a solution of the part with gains of all measurements, zero for the others."""
        if self.is_whole:
            return solution
        gains = np.zeros((2, len(solution.P), len(self.rows)))
        gains[:, :, self.rows] = solution.gain_predictor, solution.gain_filter
        gains[:, :, self.rows] /= self.units
        predictor, filtering = (frozen_copy(gain) for gain in gains)
        return replace(solution, gain_predictor=predictor, gain_filter=filtering)


_RESIDUAL_LIMIT = 1e-9
_GAMMA_TOLERANCE = 4e-12
_INDEFINITE = 1e-6  # what poles near the unit circle may leave below zero in a doubling


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelTrial:
    """Whether one level can be met, and the solution of its equation if so."""

    slack: float  # least eigenvalue of ``I - L P L' / gamma^2``; negative if it cannot be met
    P: FloatArray | None = None  # (n, n), in the units of the equation
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
    the Kalman errors have size one.
    """

    def __init__(self, problem: EstimationProblem, start: FilterRiccati) -> None:
        self.units = error_units(start.P)
        self.problem = scale_states(problem, self.units)
        self.start = _scale_solution(start, 1 / self.units)
        self.A, self.B, self.injection = decorrelate(self.problem)
        self.identity = np.eye(len(self.A))
        self.keep = self.identity - self.start.gain_filter @ self.problem.C
        filtered = self.keep @ self.start.P
        self.filtered = (filtered + filtered.T) / 2
        self.information = self.problem.C.T @ np.linalg.solve(self.problem.R, self.problem.C)

    def trial(self, gamma: float) -> LevelTrial:
        """Solve at one level, to the accuracy of the doubling."""
        L, P0 = self.problem.L, self.start.P
        seen = L @ self.filtered
        room = np.eye(L.shape[0]) - seen @ L.T / gamma**2
        if np.linalg.eigvalsh(room)[0] <= 0:
            return LevelTrial(slack=-1.0)
        W = self.information - L.T @ L / gamma**2
        spread = np.linalg.solve(room, L) / gamma**2
        widened = (self.identity + seen.T @ spread) @ self.keep
        A1, G1 = self.A @ widened, W @ widened
        H1 = self.A @ (seen.T @ spread @ self.filtered) @ self.A.T
        found, steps = doubling(A1.T[None], (G1 + G1.T)[None] / 2, (H1 + H1.T)[None] / 2)
        X = found[0]
        if not np.all(np.isfinite(X)):
            return LevelTrial(slack=-1.0)
        P = P0 + X
        spectrum = np.linalg.eigvalsh(X)
        slack = 1 - float(np.linalg.eigvalsh(L @ P @ L.T)[-1]) / gamma**2
        transition = np.linalg.solve((self.identity + X @ G1).T, A1.T).T  # A (I + P W)^-1
        if spectrum[0] < -_INDEFINITE * abs(spectrum[-1]) or not is_stable(transition):
            return LevelTrial(slack=-1.0)
        return LevelTrial(slack=slack, P=P if slack > 0 else None, iterations=int(steps[0]))

    def solution(self, gamma: float, trial: LevelTrial) -> FilterRiccati | None:
        """Refine a trial by Newton steps and form its gains; None if it is no filter."""
        if trial.P is None:
            return None
        problem, n, q = self.problem, len(self.A), len(self.problem.C)
        outputs = np.vstack([problem.C, problem.L / gamma])
        weight = block_diag(problem.R, -np.eye(len(problem.L)))
        equation = Equations(
            A=self.A.T[None],
            B=outputs.T[None],
            Q=(self.B @ self.B.T)[None],
            R=weight[None],
            S=np.zeros((1, n, len(outputs))),
        )
        P, residual = np.zeros((n, n)), 0.0
        for x, u in equation.independent_parts():
            own = np.ix_(x, x)
            refined = equation.part(x, u).refine(trial.P[own][None], np.array([trial.iterations]))
            P[own], residual = refined.X[0], max(residual, float(refined.residuals[0]))
        if residual > _RESIDUAL_LIMIT:
            raise NumericalError(
                f"the gamma-Riccati equation at gamma = {gamma:.9g} was solved only to a relative "
                f"residual of {residual:.3g}; expected {_RESIDUAL_LIMIT:g}. Try route='lmi', or "
                "scale the states to similar sizes.",
                status="residual",
                residual=residual,
            )
        # the first block column of P outputs' Re^-1, with Re the indefinite covariance of the
        # innovations of y and of z / gamma: Pt itself may be unbounded
        innovations = outputs @ P @ outputs.T + weight
        gain_filter = np.asarray(np.linalg.solve(innovations, outputs @ P)[:q].T)
        gain = self.A @ gain_filter + self.injection
        if not is_stable(problem.A - gain @ problem.C):
            return None
        solution = FilterRiccati(
            P=P,
            gain_predictor=gain,
            gain_filter=gain_filter,
            residual=residual,
            iterations=trial.iterations,
            status="doubling",
        )
        return _scale_solution(solution, self.units)


def _scale_solution(solution: FilterRiccati, units: FloatArray) -> FilterRiccati:
    """Return the solution with its states multiplied by units (n, 1)."""
    return replace(
        solution,
        P=frozen_copy(units * solution.P * units.T),
        gain_predictor=frozen_copy(units * solution.gain_predictor),
        gain_filter=frozen_copy(units * solution.gain_filter),
    )


def gamma_riccati(
    problem: EstimationProblem, gamma: float, *, start: FilterRiccati | None = None
) -> FilterRiccati | None:
    """Central H-infinity predictor of a level of gamma, by the gamma-Riccati equation.

    ``lbt_synth.design.hinf`` finds the least gamma and returns a certified design.

    Parameters
    ----------
    problem : EstimationProblem
        The problem.
    gamma : float
        The level of the norm that the filter has to meet.
    start : FilterRiccati, optional
        The Kalman filter's solution, if it is at hand.

    Returns
    -------
    FilterRiccati or None
        None where no such filter exists.

    Raises
    ------
    DetectabilityError
        If no stable filter exists at all.
    NumericalError
        If the equation has a solution that was not reached accurately.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> lbt.linear.gamma_riccati(p, 1.0) is None, lbt.linear.gamma_riccati(p, 2.5) is None
    (True, False)
    """
    start = kalman_riccati(problem) if start is None else start
    if problem.period > 1:
        from lbt_synth.linear.riccati.periodic import periodic_hinf

        return periodic_hinf(problem, gamma, start)
    part = ReadPart(problem)
    equation = GammaEquation(part.problem, part.gather(start))
    solution = equation.solution(gamma, equation.trial(gamma))
    return None if solution is None else part.scatter(solution)


def meets_level(problem: EstimationProblem, gamma: float, start: FilterRiccati) -> bool:
    """Return whether a filter meets a level of gamma; ``start`` is the Kalman filter's solution."""
    if problem.period > 1:
        return gamma_riccati(problem, gamma, start=start) is not None
    part = ReadPart(problem)
    equation = GammaEquation(part.problem, part.gather(start))
    return equation.trial(gamma).P is not None


def least_gamma(
    problem: EstimationProblem, *, lower: float, upper: float, start: FilterRiccati | None = None
) -> tuple[float, float, FilterRiccati]:
    """Bracket the least gamma, at which ``gamma^2 I - L P L'`` stops being positive.

    Returns the ends of the bracket, and the filter at the upper one. The bracket is 1e-11 wide,
    relative; with a longer period 1e-9.
    """
    start = kalman_riccati(problem) if start is None else start
    if problem.period > 1:
        from lbt_synth.linear.riccati.periodic import least_periodic_gamma

        return least_periodic_gamma(problem, lower, upper, start)
    part = ReadPart(problem)
    equation = GammaEquation(part.problem, part.gather(start))
    lower, upper, solution = _search_level(equation, lower, upper)
    return lower, upper, part.scatter(solution)


def _search_level(
    equation: GammaEquation, lower: float, upper: float
) -> tuple[float, float, FilterRiccati]:
    """Bracket the least level that an equation meets; return also the filter at the upper end."""
    met: dict[float, LevelTrial] = {}

    def slack(gamma: float) -> float:
        nonlocal lower
        trial = equation.trial(gamma)
        if trial.P is not None:
            met[gamma] = trial
        else:
            lower = max(lower, gamma)
        return trial.slack

    for _ in range(60):  # the upper level is feasible in exact arithmetic
        above = slack(upper)
        if above > 0:
            break
        upper *= 1.0001 if upper < 1.01 * lower else 1.01
    if not met:
        raise InfeasibleError(
            f"no gamma up to {upper:.6g} has an H-infinity filter; expected one at the level of "
            "the Kalman filter. Scale the states to similar sizes.",
            gamma=upper,
        )
    root = lower
    below = slack(lower) if lower < upper else 1.0
    if below <= 0:
        start_level = upper  # the slack is almost linear in s = (start_level / gamma)^2
        slack_at = {(upper / lower) ** 2: below, 1.0: above}
        s_root = brentq(
            lambda s: slack_at[s] if s in slack_at else slack(start_level * s**-0.5),
            (upper / lower) ** 2,
            1.0,
            xtol=2 * _GAMMA_TOLERANCE,
        )
        root = start_level * s_root**-0.5
    upper, width = min(met), _GAMMA_TOLERANCE
    for _ in range(100):  # the search leaves one end of its bracket far away: bring it in
        if upper - lower <= 2.5 * _GAMMA_TOLERANCE * upper:
            break
        above, below = root * (1 + width), root * (1 - width)
        if above < upper:
            slack(above)
        else:
            slack(below if below > lower and width < 1e-3 else (lower + upper) / 2)
        upper, width = min(met), 4 * width
    for gamma in sorted(met):  # a level too close to the edge may give no filter
        solution = equation.solution(gamma, met[gamma])
        if solution is not None:
            return lower, gamma, solution
    raise NumericalError(
        f"the least gamma was not bracketed: it lies between {lower:.9g} and {upper:.9g}.",
        status="search",
    )
