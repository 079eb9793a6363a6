"""Solve discrete algebraic Riccati equations, one or many at once, and verify each solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, eigvals

from lbt_synth.errors import (
    DefinitenessError,
    DetectabilityError,
    DimensionError,
    InfeasibleError,
    NumericalError,
    ProblemError,
)
from lbt_synth.linear.riccati.equations import ROUTES, Equations, Solutions
from lbt_synth.linear.state_space import balancing_scales
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
_RANK = 1e-10  # share of a matrix below which an input or an output does nothing
# A multiple eigenvalue on the circle is computed up to this far from it. It is tested on the circle
# as well, where a mode that decays passes.
_CIRCLE = 1e-3
_ROUNDING = 1e-14  # share of a pencil that rounding of the data may be: its singular value is zero
_ELSEWHERE = 0.37 + 0.61j  # an arbitrary point, at which only a singular pencil is singular


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
    # routes that solved something, in the order they were tried: "doubling", "shifted doubling" and
    # "schur"
    route: str

    @property
    def residual(self) -> float:
        """Largest relative residual."""
        return float(np.max(self.residuals, initial=0.0))

    @property
    def error(self) -> float:
        """Largest estimate of the relative error of X."""
        return float(np.max(self.errors, initial=0.0))


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
        route=max((part.route for part in joined), key=len),
    )


def _solve_stack(equations: Equations, lead: tuple[int, ...]) -> DareSolution:
    """Solve a stack, verify each answer, and put the leading dimensions back."""
    balanced, factors, units = equations.scaled()
    best, route = _try_routes(balanced)
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
        _refuse(int(np.flatnonzero(~solved)[0]), lead, best)
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
        route=route,
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


def _try_routes(equations: Equations) -> tuple[Solutions, str]:
    """Try the routes in order, each on the equations that are still unsolved; keep the best.

    Return the names of the routes that solved something as well, or of all.
    """
    count, (n, m) = len(equations.A), equations.B.shape[-2:]
    best = Solutions(
        X=np.full((count, n, n), np.nan),
        gains=np.full((count, m, n), np.nan),
        poles=np.full((count, n), np.nan, dtype=np.complex128),
        residuals=np.full(count, np.inf),
        errors=np.full(count, np.inf),
        steps=np.zeros(count, dtype=np.int64),
    )
    names, pending = [], np.arange(count)
    for route, solve in ROUTES:
        unsolved = equations.take(pending)
        trial = unsolved.refine(*solve(unsolved))
        stable = np.abs(trial.poles).max(axis=-1) < 1
        trial = replace(trial, residuals=np.where(stable, trial.residuals, np.inf))
        better = trial.residuals < best.residuals[pending]
        best.replace_rows(pending[better], trial, better)
        satisfied = (trial.residuals <= RESIDUAL_LIMIT) & (trial.errors <= _SATISFIED)
        names += [route] if satisfied.any() else []
        pending = pending[~satisfied]
        if not pending.size:
            break
    return best, ", ".join(names or [route for route, _ in ROUTES])


def _prefix(index: int, lead: tuple[int, ...]) -> str:
    """Prefix of a message that names one equation of a stack; empty for a single equation."""
    if not lead:
        return ""
    where = tuple(int(i) for i in np.unravel_index(index, lead))
    return f"equation {where[0] if len(where) == 1 else where}: "


def _refuse(index: int, lead: tuple[int, ...], best: Solutions) -> None:
    """Refuse an equation that no route solved."""
    residual, error = float(best.residuals[index]), float(best.errors[index])
    stable = bool(np.isfinite(residual))
    outcome = "no stable closed loop"
    if stable:
        gap = 1 - float(np.abs(best.poles[index]).max())
        outcome = (
            f"a relative residual of {residual:.3g}, an estimated error of {error:.3g} and a pole "
            f"{gap:.3g} inside the unit circle"
        )
    raise NumericalError(
        f"{_prefix(index, lead)}the Riccati equation was not solved: "
        f"{', '.join(route for route, _ in ROUTES)} gave {outcome}; expected a stable "
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


def unstable_hidden_mode(
    A: FloatArray, C: FloatArray, *, drive: FloatArray, only_unit_circle: bool = False
) -> complex | None:
    """Eigenvalue of A that does not decay and that C does not see, or None.

    The Popov-Belevitch-Hautus test on the eigenvalues with modulus 1 or more
    (or about 1, with ``only_unit_circle``). ``drive`` (n, p), which enters the states,
    serves to scale them, because the answer must not depend on their units.
    """
    n = A.shape[0]
    entry, leaving = np.linalg.norm(drive, axis=1), np.linalg.norm(C, axis=0)
    units = balancing_scales(A, entry, leaving)[:n]
    A, C = A * units / units[:, None], C * units
    scale_A = max(float(np.linalg.norm(A, 2)), 1e-300)
    scale_C = max(float(np.linalg.norm(C, 2)), 1e-300)
    points: list[tuple[complex, float]] = []
    for value in np.linalg.eigvals(A):
        size = abs(value)
        if size >= 1 - _RANK and not (only_unit_circle and size > 1 + _RANK):
            points.append((complex(value), _RANK))
        if abs(size - 1) < _CIRCLE:
            points.append((complex(value / size), _ROUNDING))
    for point, tolerance in points:
        pencil = np.vstack([(A - point * np.eye(n)) / scale_A, C / scale_C])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < tolerance:
            return point
    return None


def require_stabilising(equations: Equations, index: int, name: str = "") -> None:
    """Raise if an equation has no stabilising solution for a reason that can be named."""
    A, B, Q, R, S = (getattr(equations, key)[index] for key in "ABQRS")
    hidden = unstable_hidden_mode(A.T, B.T, drive=weight_root(Q))
    if hidden is not None:
        raise DetectabilityError(
            f"{name}(A, B) must be stabilisable; the mode of A at {hidden:.6g} does not decay and "
            "B does not reach it. Give it an input, or take it out of the model.",
            eigenvalue=hidden,
        )
    inputs = np.vstack([part / max(np.abs(part).max(), 1e-300) for part in (B, R, S)])
    if np.linalg.svd(inputs, compute_uv=False)[-1] < _RANK:
        raise DefinitenessError(
            f"{name}R must be positive definite, or B and S must act where it is not; got a "
            "combination of inputs that has no weight and no effect. Leave it out."
        )
    if np.linalg.eigvalsh(R)[0] > 0:
        feedback = np.linalg.solve(R, S.T)
        weight = Q - S @ feedback
        hidden = unstable_hidden_mode(
            A - B @ feedback, weight_root((weight + weight.T) / 2).T, drive=B, only_unit_circle=True
        )
        if hidden is not None:
            raise DetectabilityError(
                f"{name}Q must see every mode on the unit circle; the mode of A at {hidden:.6g} "
                "has no weight, so there is no stabilising solution. Add a small weight on it.",
                eigenvalue=hidden,
            )
    zero = _unit_circle_zero(A, B, Q, R, S, name)
    if zero is not None:
        raise DetectabilityError(
            f"{name}to rounding, the equation has a zero on the unit circle, at {zero:.6g}: there "
            "its weights leave an oscillation free of cost, so there is no stabilising solution. "
            "Add a small weight.",
            eigenvalue=zero,
        )


def weight_root(weight: FloatArray) -> FloatArray:
    """Columns whose squares add up to the absolute value of a symmetric matrix."""
    values, vectors = np.linalg.eigh(weight)
    size = np.abs(values)
    size = np.where(size > 1e-14 * size.max(initial=0.0), size, 0.0)  # a root doubles its digits
    return np.asarray(vectors * np.sqrt(size), dtype=np.float64)


def _unit_circle_zero(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray, name: str
) -> complex | None:
    """Eigenvalue on the unit circle of the extended symplectic pencil, or None."""
    (n, m), zero = B.shape, np.zeros
    weight = max(np.abs(Q).max(), np.abs(R).max(), np.abs(S).max(), 1e-300)
    Q, R, S = Q / weight, R / weight, S / weight
    M = np.block([[A, zero((n, n)), B], [-Q, np.eye(n), -S], [S.T, zero((m, n)), R]])
    N = block_diag(np.eye(n), np.vstack([A.T, -B.T]), zero((0, m)))
    size = float(np.linalg.norm(M, 2))
    elsewhere = M - _ELSEWHERE * N
    elsewhere = elsewhere / np.maximum(np.abs(elsewhere).max(axis=1, keepdims=True), 1e-300)
    if np.linalg.svd(elsewhere, compute_uv=False)[-1] < _ROUNDING:
        raise DefinitenessError(
            f"{name}R + B'XB must not be singular; it is, whatever X: some input has neither a "
            "weight nor an effect that Q sees. Give R or Q a small weight there."
        )
    values = eigvals(M, N)
    for value in values[np.isfinite(values)]:
        if abs(abs(value) - 1) > _CIRCLE:
            continue
        on_circle = value / abs(value)
        if np.linalg.svd(M - on_circle * N, compute_uv=False)[-1] < _ROUNDING * size:
            return complex(on_circle)
    return None
