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
    status : str
        Method that gave P.
    """

    P: FloatArray
    gain_predictor: FloatArray
    gain_filter: FloatArray
    residual: float
    iterations: int
    status: str


def require_detectable(problem: EstimationProblem) -> None:
    """Raise where no stable filter exists.

    Raises
    ------
    DetectabilityError
        The message names the mode.
    """
    hidden = unstable_hidden_mode(problem.A, problem.C, drive=problem.B)
    if hidden is not None:
        raise DetectabilityError(
            f"(A, C) must be detectable; the mode of A at {hidden:.6g} does not decay and no "
            "measurement sees it. Measure it, or take it out of the model.",
            eigenvalue=hidden,
        )
    A_s, B_s, _ = decorrelated(problem)
    hidden = unstable_hidden_mode(A_s.T, B_s.T, drive=problem.C.T, only_unit_circle=True)
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
        status=dare.method,
    )


def gamma_riccati(
    problem: EstimationProblem, gamma: float, *, start: FilterRiccati | None = None
) -> FilterRiccati | None:
    """Solve ``P = A P (I + W P)^-1 A' + BB'``, ``W = C'R^-1 C - L'L / gamma^2``.

    A predictor with an error norm below gamma exists if and only if the
    stabilising P is positive semidefinite and ``gamma^2 I - L P L' > 0``; the gain
    is ``A Pt C'(R + C Pt C')^-1`` with ``Pt = P + P L'(gamma^2 I - L P L')^-1 L P``.
    Correlated noise is taken out first.

    The equation is solved for the excess over the Kalman filter's P0. With the
    filtered covariance M, F = I - gain_filter C and
    ``N = I + M L'(gamma^2 I - L M L')^-1 L``::

        P = P0 + X,   X = A1 X (I + G1 X)^-1 A1' + H1
        A1 = A N F,   G1 = W N F,   H1 = A M L'(gamma^2 I - L M L')^-1 L M A'

    H1 is positive semidefinite and holds no difference of large numbers, so the
    doubling starts inside the stabilising solution's reach.

    Parameters
    ----------
    problem : EstimationProblem
        The problem.
    gamma : float
        Level asked for.
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
    >>> from lbt_synth.riccati import gamma_riccati
    >>> p = lbt.EstimationProblem(A=1.0, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    >>> gamma_riccati(p, 1.0) is None, gamma_riccati(p, 2.5) is None
    (True, False)
    """
    kalman_filter = kalman_riccati(problem) if start is None else start
    A, _, injection = decorrelated(problem)
    C, L = problem.C, problem.L
    identity = np.eye(len(A))
    P0, keep = kalman_filter.P, identity - kalman_filter.gain_filter @ C
    filtered = keep @ P0
    filtered = (filtered + filtered.T) / 2
    seen = L @ filtered
    room = gamma**2 * np.eye(L.shape[0]) - seen @ L.T
    if np.linalg.eigvalsh(room)[0] <= 0:
        return None
    weighted = np.linalg.solve(problem.R, C).T  # C' R^-1
    W = weighted @ C - L.T @ L / gamma**2
    widened = (identity + seen.T @ np.linalg.solve(room, L)) @ keep
    A1, G1 = A @ widened, W @ widened
    H1 = A @ seen.T @ np.linalg.solve(room, seen @ A.T)
    G1, H1 = (G1 + G1.T) / 2, (H1 + H1.T) / 2
    X, steps, converged = doubling(A1.T, G1, H1)
    if not converged:
        return None
    spectrum = np.linalg.eigvalsh(X)
    P = P0 + X
    slack = gamma**2 * np.eye(L.shape[0]) - L @ P @ L.T
    if spectrum[0] < -1e-9 * abs(spectrum[-1]) or np.linalg.eigvalsh(slack)[0] <= 0:
        return None
    transition = np.linalg.solve((identity + X @ G1).T, A1.T).T  # A (I + P W)^-1
    if not np.max(np.abs(np.linalg.eigvals(transition))) < 1:
        return None
    gain_filter = _measurement_update(problem, P, gamma)
    gain = A @ gain_filter + injection
    if not np.max(np.abs(np.linalg.eigvals(problem.A - gain @ C))) < 1:
        return None
    AXA = transition @ X @ A1.T
    size = sum(float(np.linalg.norm(t, 1)) for t in (P, X, AXA, H1))
    residual = float(np.linalg.norm(AXA - X + H1, 1)) / max(size, 1e-300)
    if residual > _RESIDUAL_LIMIT:
        raise NumericalError(
            f"the gamma-Riccati equation at gamma = {gamma:.9g} was solved only to a relative "
            f"residual of {residual:.3g}; expected {_RESIDUAL_LIMIT:g}. Try method='lmi', or scale "
            "the states to similar sizes.",
            status="residual",
            residual=residual,
        )
    return FilterRiccati(
        P=frozen(P),
        gain_predictor=frozen(gain),
        gain_filter=frozen(gain_filter),
        residual=residual,
        iterations=steps,
        status="doubling",
    )


def _measurement_update(problem: EstimationProblem, P: FloatArray, gamma: float) -> FloatArray:
    """Gain ``Pt C'(R + C Pt C')^-1`` without forming Pt, which may be unbounded.

    The first block column of ``P [C' L'/gamma] Re^-1``, where Re is the indefinite
    covariance of the two innovations, of y and of z / gamma.
    """
    q = problem.C.shape[0]
    outputs = np.vstack([problem.C, problem.L / gamma])
    covariance = outputs @ P @ outputs.T
    covariance[:q, :q] += problem.R
    covariance[q:, q:] -= np.eye(problem.L.shape[0])
    return np.asarray(np.linalg.solve(covariance, outputs @ P)[:q].T, dtype=np.float64)


def least_gamma(
    problem: EstimationProblem, *, lower: float, upper: float, start: FilterRiccati | None = None
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
    start : FilterRiccati, optional
        The Kalman filter's solution, if it is at hand.

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
    start = kalman_riccati(problem) if start is None else start
    best = None
    for _ in range(60):  # the upper level is feasible in exact arithmetic
        best = gamma_riccati(problem, upper, start=start)
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
        trial = gamma_riccati(problem, middle, start=start)
        if trial is None:
            lower = middle
        else:
            upper, best = middle, trial
    raise NumericalError(
        f"the least gamma was not bracketed: it lies between {lower:.9g} and {upper:.9g}.",
        status="bisection",
    )
