"""Solve discrete algebraic Riccati equations, one or many at once, and verify each solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, InfeasibleError, NumericalError, ProblemError
from lbt_synth.linear.riccati.equations import Equations, Solutions
from lbt_synth.linear.riccati.routes import ROUTES
from lbt_synth.linear.riccati.solvability import require_stabilising
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    IntArray,
    frozen_copy,
    matrix,
    read_only,
    square,
    symmetric,
)

RESIDUAL_LIMIT = 1e-12  # a solution beyond one of these limits is refused
ERROR_LIMIT = 1e-3
_SATISFIED = 1e-8  # if the estimated error of X is larger, the next route is tried
# Rounding may have moved a pole this close to the unit circle off the circle itself. The solution
# exists if Newton's method, started at X, converges in spite of rounding (Kantorovich: below 1/4).
_NEAR = 1e-2
_CONTRACTION = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """What one route did."""

    route: str  # "doubling", "shifted doubling" or "schur"
    # numbers of equations that it was given, and that it solved
    tried: int
    solved: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DareSolution:
    """Stabilising solution of a discrete algebraic Riccati equation, or of a stack of them."""

    X: FloatArray  # (..., n, n): the solution, symmetric
    # (..., m, n): ``(R + B'XB)^-1 (B'XA + S')``; the closed loop is ``A - B gain_feedback``
    gain_feedback: FloatArray
    poles: ComplexArray  # (..., n): poles of the closed loop
    # (...): relative residual of each equation: its norm (Frobenius) over ``||X|| (1 + ||closed
    # loop||^2) + ||A'XA|| + ||Q||``, in units of the states that balance the equation. The first
    # term is what rounding X can make of it
    residuals: FloatArray
    # (...): estimate of the relative error of X: the size of the next Newton step. It grows with
    # the condition of the equation
    errors: FloatArray
    # (...): number of negative eigenvalues of ``R + B'XB``. Where it is zero, X is the least cost
    # of the control problem; elsewhere X is a saddle point
    negative: IntArray
    iterations: int  # most doublings made for an equation
    attempts: tuple[Attempt, ...]  # routes in the order they were tried

    @property
    def residual(self) -> float:
        """Largest relative residual."""
        return float(np.max(self.residuals, initial=0.0))

    @property
    def error(self) -> float:
        """Largest estimate of the relative error of X."""
        return float(np.max(self.errors, initial=0.0))

    @property
    def route(self) -> str:
        """Routes that solved something, in the order they were tried."""
        solvers = [attempt.route for attempt in self.attempts if attempt.solved]
        return ", ".join(solvers or [attempt.route for attempt in self.attempts])


def solve_dare(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, S: ArrayLike | None = None
) -> DareSolution:
    """Solve ``X = A'XA + Q - (A'XB + S)(R + B'XB)^-1 (B'XA + S')`` for its stabilising X.

    Three routes are tried in turn: structured doubling in balanced units; doubling from
    some steps of the Riccati recursion, which a singular R needs; and the ordered Schur
    form of the extended pencil. Each answer is refined by Newton steps on a residual in
    extended precision, and verified: a stable closed loop and a small residual make it
    the stabilising solution, of which there is only one. For the filter equation pass
    ``(A', C', B B', D D', B D')``.

    Leading dimensions of the arguments are those of a stack of equations, broadcast
    against each other and solved at once.

    Parameters
    ----------
    A : (..., n, n) array_like
        State matrix.
    B : (..., n, m) array_like
        Input matrix.
    Q : (..., n, n) array_like
        State weight, symmetric.
    R : (..., m, m) array_like
        Input weight, symmetric. It may be singular. If it has negative eigenvalues the
        equation is that of an H-infinity problem, and X must then be positive
        semidefinite and leave ``R + B'XB`` the signs of R.
    S : (..., n, m) array_like, optional
        Cross weight.

    Returns
    -------
    DareSolution
        The solution, its gain, its poles and the residual that was measured.

    Raises
    ------
    DimensionError, NonFiniteError, DefinitenessError
        If the input is wrong.
    DetectabilityError
        If there is no stabilising solution; the message names the mode, or the zero on
        the unit circle.
    InfeasibleError
        If R is indefinite and the stabilising solution does not meet its conditions.
    NumericalError
        If no route reaches a stable closed loop, a relative residual of 1e-12 and an
        estimated error of 1e-3.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> round(float(lbt.solve_dare(1, 1, 1, 1).X[0, 0]), 12)  # (1 + sqrt 5) / 2
    1.61803398875

    Three equations at once:

    >>> lbt.solve_dare(1, 1, [[[1]], [[2]], [[6]]], 1).X.ravel().round(6).tolist()
    [1.618034, 2.732051, 6.872983]
    """
    equations, lead = _stack_arguments(A, B, Q, R, S)
    parts = [] if lead else equations.independent_parts()
    with np.errstate(all="ignore"):  # anything not finite is refused
        if len(parts) < 2:
            return _solve_stack(equations, lead)
        return _join_parts(equations, parts)


def _join_parts(equations: Equations, parts: list[tuple[IntArray, IntArray]]) -> DareSolution:
    """Solve the parts of an equation, equal ones once, and put their solutions side by side."""
    X, gain = np.zeros_like(equations.Q[0]), np.zeros_like(equations.B[0].T)
    solved: dict[tuple[bytes, ...], DareSolution] = {}
    joined = []
    for x, u in parts:
        part = equations.part(x, u)
        key = tuple(getattr(part, name).tobytes() for name in "ABQRS")
        if key not in solved:
            solved[key] = _solve_stack(part, ())
        X[np.ix_(x, x)], gain[np.ix_(u, x)] = solved[key].X, solved[key].gain_feedback
        joined.append(solved[key])
    return DareSolution(
        X=read_only(X),
        gain_feedback=read_only(gain),
        poles=read_only(np.concatenate([part.poles for part in joined])),
        residuals=read_only(np.max([part.residuals for part in joined], axis=0)),
        errors=read_only(np.max([part.errors for part in joined], axis=0)),
        negative=read_only(np.sum([part.negative for part in joined], axis=0)),
        iterations=max(part.iterations for part in joined),
        attempts=max((part.attempts for part in joined), key=len),
    )


def _solve_stack(equations: Equations, lead: tuple[int, ...]) -> DareSolution:
    """Solve a stack, verify each answer, and put the leading dimensions back."""
    balanced, factors, units = equations.scaled()
    best, attempts = _try_routes(balanced)
    radius = np.abs(best.poles).max(axis=-1)

    solved = (radius < 1) & (best.residuals <= RESIDUAL_LIMIT) & (best.errors <= ERROR_LIMIT)
    near = np.flatnonzero(solved & (1 - radius <= _NEAR))
    doubtful = balanced.take(near).contractions(best.X[near], best.gains[near])
    solved[near] = doubtful <= _CONTRACTION
    for i in np.flatnonzero(~solved):
        try:
            require_stabilising(balanced, int(i), _prefix(int(i), lead))
        except ProblemError:
            raise
        except ValueError:  # numbers out of range (LinAlgError): refused without a reason
            continue
    if not solved.all():
        _refuse(int(np.flatnonzero(~solved)[0]), lead, best, attempts)
    X = best.X
    weights = balanced.weights(X)
    negative = np.sum(np.linalg.eigvalsh(weights) < 0, axis=-1)
    _require_saddle(balanced.R, X, negative, lead)

    column, row = units[:, None, :], units[:, :, None]
    n, m = equations.B.shape[-2:]
    return DareSolution(
        X=frozen_copy((X / column / row * factors[:, None, None]).reshape(*lead, n, n)),
        gain_feedback=frozen_copy((best.gains / column).reshape(*lead, m, n)),
        poles=read_only(best.poles.reshape(*lead, n)),
        residuals=frozen_copy(best.residuals.reshape(lead)),
        errors=frozen_copy(best.errors.reshape(lead)),
        negative=read_only(negative.reshape(lead)),
        iterations=int(np.max(best.steps, initial=0)),
        attempts=attempts,
    )


def _stack_arguments(A: Any, B: Any, Q: Any, R: Any, S: Any) -> tuple[Equations, tuple[int, ...]]:
    """Check the arguments; return them as one stack, and its leading dimensions."""
    A = square(A, "A", stacked=True)
    n, why = A.shape[-1], f"to match A {A.shape}"
    B = matrix(B, "B", rows=(n, why), stacked=True)
    m, also = B.shape[-1], f"to match B {B.shape}"
    if m == 0:
        raise DimensionError(f"B must have at least one column; got {B.shape}.")
    Q = symmetric(Q, "Q", size=(n, why), stacked=True)
    R = symmetric(R, "R", size=(m, also), stacked=True)
    S = matrix(
        np.zeros((n, m)) if S is None else S, "S", rows=(n, why), cols=(m, also), stacked=True
    )
    parts = {"A": A, "B": B, "Q": Q, "R": R, "S": S}
    try:
        lead = np.broadcast_shapes(*(part.shape[:-2] for part in parts.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {part.shape}" for name, part in parts.items())
        raise DimensionError(
            f"the leading dimensions must be the same or 1, to be stacked; got {shapes}."
        ) from error
    stacks = {
        name: np.broadcast_to(part, lead + part.shape[-2:]).reshape(-1, *part.shape[-2:])
        for name, part in parts.items()
    }
    return Equations(**stacks), lead


def _try_routes(equations: Equations) -> tuple[Solutions, tuple[Attempt, ...]]:
    """Try the routes in order, each on the equations that are still unsolved; keep the best."""
    best: Solutions | None = None
    attempts = []
    pending = np.arange(len(equations.A))
    for route, solve in ROUTES:
        if best is not None and pending.size == 0:
            break
        part = equations.take(pending)
        found = part.refine(*solve(part))
        stable = np.abs(found.poles).max(axis=-1) < 1
        found = replace(found, residuals=np.where(stable, found.residuals, np.inf))
        best = best or found
        better = found.residuals < best.residuals[pending]
        best.replace_rows(pending[better], found, better)
        satisfied = (found.residuals <= RESIDUAL_LIMIT) & (found.errors <= _SATISFIED)
        attempts.append(Attempt(route=route, tried=pending.size, solved=int(satisfied.sum())))
        pending = pending[~satisfied]
    assert best is not None  # there are routes
    return best, tuple(attempts)


def _prefix(index: int, lead: tuple[int, ...]) -> str:
    """Prefix of a message that names one equation of a stack; empty for a single equation."""
    if not lead:
        return ""
    where = tuple(int(i) for i in np.unravel_index(index, lead))
    return f"equation {where[0] if len(where) == 1 else where}: "


def _refuse(
    index: int, lead: tuple[int, ...], best: Solutions, attempts: tuple[Attempt, ...]
) -> None:
    residual, error = float(best.residuals[index]), float(best.errors[index])
    stable = bool(np.isfinite(residual))
    found = "no stable closed loop"
    if stable:
        gap = 1 - float(np.abs(best.poles[index]).max())
        found = (
            f"a relative residual of {residual:.3g}, an estimated error of {error:.3g} and a pole "
            f"{gap:.3g} inside the unit circle"
        )
    raise NumericalError(
        f"{_prefix(index, lead)}the Riccati equation was not solved: "
        f"{', '.join(attempt.route for attempt in attempts)} gave {found}; expected a stable "
        f"closed loop, a residual below {RESIDUAL_LIMIT:g} and an estimated error below "
        f"{ERROR_LIMIT:g}, and a pole further from the unit circle than rounding can move it. "
        "There may be no stabilising solution; look for modes near the unit circle that are barely "
        "driven or seen.",
        status="residual",
        residual=residual if stable else None,
    )


def _require_saddle(
    R: FloatArray, X: FloatArray, negative: IntArray, lead: tuple[int, ...]
) -> None:
    """Check the existence conditions of the H-infinity problem where R is indefinite."""
    values = np.linalg.eigvalsh(R)
    expected = np.sum(values < -1e-12 * np.abs(values).max(axis=-1, keepdims=True), axis=-1)
    for i in np.flatnonzero(expected > 0):
        spectrum = np.linalg.eigvalsh(X[i])
        if negative[i] != expected[i]:
            wrong = (
                f"R + B'XB must have as many negative eigenvalues as R, {expected[i]}; got "
                f"{negative[i]}."
            )
        elif spectrum[0] < -1e-9 * max(abs(spectrum[-1]), abs(spectrum[0])):
            wrong = (
                "X must be positive semidefinite, as R is indefinite; got an eigenvalue of "
                f"{spectrum[0]:.3g}."
            )
        else:
            continue
        raise InfeasibleError(
            f"{_prefix(int(i), lead)}{wrong} The level that R holds cannot be met: try a larger "
            "one."
        )
