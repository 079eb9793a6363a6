"""Riccati equations of the Kalman and the H-infinity predictor.

B. Hassibi, A. H. Sayed, T. Kailath, "Indefinite-Quadratic Estimation and
Control", SIAM (1999), doi:10.1137/1.9781611970760, chapter 4 (a-priori filter).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.errors import DetectabilityError, InfeasibleError, NumericalError
from lbt_synth.gains import decorrelated
from lbt_synth.models.problem import EstimationProblem
from lbt_synth.riccati.dare import solve_dare, unstable_hidden_mode
from lbt_synth.riccati.doubling import doubling
from lbt_synth.validation import FloatArray, frozen

_RESIDUAL_LIMIT = 1e-7
_GAMMA_TOLERANCE = 1e-11


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilterRiccati:
    """A solved filter equation.

    Attributes
    ----------
    P : (n, n) ndarray
        Covariance of the prediction error (Kalman), or its H-infinity counterpart.
    gain_predictor, gain_filter : (n, q) ndarray
        Gains of the time-and-measurement update, and of the measurement update alone.
    residual : float
        Relative residual of the equation.
    iterations : int
        Doublings made.
    method : str
        Route that gave P.
    """

    P: FloatArray
    gain_predictor: FloatArray
    gain_filter: FloatArray
    residual: float
    iterations: int
    method: str


def require_detectable(problem: EstimationProblem) -> None:
    """Raise where no stable filter exists.

    Raises
    ------
    DetectabilityError
        The message names the mode.
    """
    hidden = unstable_hidden_mode(problem.A, problem.C)
    if hidden is not None:
        raise DetectabilityError(
            f"(A, C) must be detectable; the mode of A at {hidden:.6g} does not decay and no "
            "measurement sees it. Measure it, or take it out of the model.",
            eigenvalue=hidden,
        )
    A_s, B_s, _ = decorrelated(problem)
    hidden = unstable_hidden_mode(A_s.T, B_s.T, only_unit_circle=True)
    if hidden is not None:
        raise DetectabilityError(
            f"every mode on the unit circle must be driven by noise; the mode of A at "
            f"{hidden:.6g} is not, so the filter would stop correcting it. Add a column to B.",
            eigenvalue=hidden,
        )


def kalman_riccati(problem: EstimationProblem) -> FilterRiccati:
    """Solve ``P = A P A' + Q - (A P C' + S)(R + C P C')^-1 (C P A' + S')``.

    Parameters
    ----------
    problem : EstimationProblem
        The problem.

    Returns
    -------
    FilterRiccati
        Stabilising solution and its gains.

    Raises
    ------
    DetectabilityError
        If there is no stabilising solution.
    NumericalError
        If the equation was not solved.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.riccati import kalman_riccati
    >>> p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> round(float(kalman_riccati(p).P[0, 0]), 12)
    1.61803398875
    """
    require_detectable(problem)
    dare = solve_dare(problem.A.T, problem.C.T, problem.Q, problem.R, problem.S)
    innovation = problem.R + problem.C @ dare.X @ problem.C.T
    gain_filter = np.linalg.solve(innovation, problem.C @ dare.X).T
    return FilterRiccati(
        P=dare.X,
        gain_predictor=frozen(dare.gain_feedback.T),
        gain_filter=frozen(gain_filter),
        residual=dare.residual,
        iterations=dare.iterations,
        method=dare.method,
    )


def gamma_riccati(problem: EstimationProblem, gamma: float) -> FilterRiccati | None:
    """Solve ``P = A P (I + W P)^-1 A' + BB'``, ``W = C'R^-1 C - L'L / gamma^2``.

    A predictor with an error norm below gamma exists if and only if the
    stabilising P is positive semidefinite and ``gamma^2 I - L P L' > 0``; with
    ``Pt = P + P L'(gamma^2 I - L P L')^-1 L P`` the gain is
    ``A Pt C'(R + C Pt C')^-1``. Correlated noise is taken out first.

    Parameters
    ----------
    problem : EstimationProblem
        The problem; detectability is not checked here.
    gamma : float
        Level asked for.

    Returns
    -------
    FilterRiccati or None
        None where no such filter exists.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.riccati import gamma_riccati
    >>> p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> gamma_riccati(p, 1.0) is None, gamma_riccati(p, 2.5) is None
    (True, False)
    """
    A, B, injection = decorrelated(problem)
    C, L, R = problem.C, problem.L, problem.R
    weight = C.T @ np.linalg.solve(R, C) - L.T @ L / gamma**2
    weight, Q = (weight + weight.T) / 2, B @ B.T
    P, steps, converged = doubling(A.T, weight, Q)
    if not converged:
        return None
    slack = gamma**2 * np.eye(L.shape[0]) - L @ P @ L.T
    if np.linalg.eigvalsh(slack)[0] <= 0:
        return None
    spectrum = np.linalg.eigvalsh(P)
    if spectrum[0] < -1e-9 * spectrum[-1]:
        return None
    transition = np.linalg.solve(np.eye(len(A)) + weight @ P, A.T).T  # A (I + P W)^-1
    APA = transition @ P @ A.T
    size = sum(float(np.linalg.norm(t, 1)) for t in (P, APA, Q))
    residual = float(np.linalg.norm(APA - P + Q, 1)) / size
    if residual > _RESIDUAL_LIMIT or not np.max(np.abs(np.linalg.eigvals(transition))) < 1:
        return None
    LP = L @ P
    Pt = P + LP.T @ np.linalg.solve(slack, LP)
    gain_filter = np.linalg.solve(R + C @ Pt @ C.T, C @ Pt).T
    gain = A @ gain_filter + injection
    if not np.max(np.abs(np.linalg.eigvals(problem.A - gain @ C))) < 1:
        return None
    return FilterRiccati(
        P=frozen(P),
        gain_predictor=frozen(gain),
        gain_filter=frozen(gain_filter),
        residual=residual,
        iterations=steps,
        method="doubling",
    )


def least_gamma(
    problem: EstimationProblem, *, lower: float, upper: float
) -> tuple[float, float, FilterRiccati]:
    """Bisect for the least gamma: bracket and the filter at its upper end.

    Parameters
    ----------
    problem : EstimationProblem
        The problem.
    lower : float
        A level that cannot be met: the standard deviation of the Kalman error in
        its worst direction, for P grows as gamma falls.
    upper : float
        A level that is met: the norm that the Kalman filter achieves.

    Returns
    -------
    lower, upper : float
        Bracket: infeasible below, feasible above.
    filter : FilterRiccati
        Solution at ``upper``.

    Raises
    ------
    InfeasibleError
        If no level is feasible.
    NumericalError
        If the bisection does not close.
    """
    best = None
    for _ in range(60):  # the upper level is feasible in exact arithmetic
        best = gamma_riccati(problem, upper)
        if best is not None:
            break
        upper *= 1.0001 if upper < 1.01 * lower else 1.01
    if best is None:
        raise InfeasibleError(
            f"no gamma up to {upper:.6g} has an H-infinity filter; expected one at the level of "
            "the Kalman filter. Scale the states to similar sizes.",
            gamma=upper,
        )
    for _ in range(200):
        if upper - lower <= _GAMMA_TOLERANCE * upper:
            return lower, upper, best
        middle = (lower + upper) / 2
        trial = gamma_riccati(problem, middle)
        if trial is None:
            lower = middle
        else:
            upper, best = middle, trial
    raise NumericalError(
        f"the least gamma was not bracketed: it lies between {lower:.9g} and {upper:.9g}.",
        status="bisection",
    )
