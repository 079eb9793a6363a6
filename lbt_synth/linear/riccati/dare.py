"""Solve discrete algebraic Riccati equations, one or many at once, and verify each solution."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import (
    DefinitenessError,
    DetectabilityError,
    DimensionError,
    NumericalError,
    ProblemError,
)
from lbt_synth.linear.riccati.equations import (
    Equations,
    Solutions,
    solve_by_doubling,
    solve_by_schur,
)
from lbt_synth.linear.state_space import balancing_scales
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
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
_NOTHING = 1e-6  # part of the largest share of a state in a mode, that counts as none
_ROUNDING = 1e-14  # share of a pencil that rounding of the data may be: its singular value is zero


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
    iterations: int  # most doublings made for an equation
    route: str  # that solved the equations: "doubling", or "schur" where that solved some

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

    Structured doubling in balanced units is tried first, then the ordered Schur form of
    the extended pencil. Each answer is refined by Newton steps on a residual in extended
    precision, and verified: a stable closed loop and a small residual make it the
    stabilising solution, of which there is only one. For the filter equation pass
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
        equation is that of an H-infinity problem, whose level can be met if X is positive
        semidefinite and ``R + B'XB`` has the signs of R.
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
        If a mode has no stabilising solution; the message names it.
    NumericalError
        If neither route reaches a stable closed loop, a relative residual of 1e-12 and an
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
    with np.errstate(all="ignore"):  # anything not finite is refused
        balanced, factors, units = equations.scaled()
        best, route, steps = _try_routes(balanced)
        _require_solved(balanced, best, lead)
    column, row = units[:, None, :], units[:, :, None]
    n, m = equations.B.shape[-2:]
    return DareSolution(
        X=frozen_copy((best.X / column / row * factors[:, None, None]).reshape(*lead, n, n)),
        gain_feedback=frozen_copy((best.gains / column).reshape(*lead, m, n)),
        poles=read_only(best.poles.reshape(*lead, n)),
        residuals=frozen_copy(best.residuals.reshape(lead)),
        errors=frozen_copy(best.errors.reshape(lead)),
        iterations=steps,
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


def _try_routes(equations: Equations) -> tuple[Solutions, str, int]:
    """Double, and take the Schur form where it leaves less; return the route and the doublings."""
    X, steps = solve_by_doubling(equations)
    best, route = _refined(equations, X), "doubling"
    poor = np.flatnonzero(~((best.residuals <= RESIDUAL_LIMIT) & (best.errors <= _SATISFIED)))
    if poor.size:
        unsolved = equations.take(poor)
        trial = _refined(unsolved, solve_by_schur(unsolved))
        better = trial.residuals < best.residuals[poor]
        for field in fields(best):
            getattr(best, field.name)[poor[better]] = getattr(trial, field.name)[better]
        route = "schur" if better.any() else route
    return best, route, steps


def _refined(equations: Equations, X: FloatArray) -> Solutions:
    """Refine X, and give those without a stable closed loop an infinite residual."""
    solutions = equations.refine(X)
    stable = np.abs(solutions.poles).max(axis=-1) < 1
    return replace(solutions, residuals=np.where(stable, solutions.residuals, np.inf))


def _require_solved(equations: Equations, best: Solutions, lead: tuple[int, ...]) -> None:
    """Raise if an equation of a stack is not solved, for a reason that can be named or without."""
    radius = np.abs(best.poles).max(axis=-1)
    solved = (radius < 1) & (best.residuals <= RESIDUAL_LIMIT) & (best.errors <= ERROR_LIMIT)
    near = np.flatnonzero(solved & (1 - radius <= _NEAR))
    doubtful = equations.take(near).contractions(best.X[near], best.gains[near])
    solved[near] = doubtful <= _CONTRACTION
    unsolved = np.flatnonzero(~solved)
    for i in unsolved:
        try:
            require_stabilising(equations, int(i), _prefix(int(i), lead))
        except ProblemError:
            raise
        except ValueError:  # numbers out of range (LinAlgError): refused without a reason
            continue
    if unsolved.size:
        _refuse(int(unsolved[0]), lead, best)


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
        f"doubling and the Schur form gave {outcome}; expected a stable closed loop, "
        f"a residual below {RESIDUAL_LIMIT:g} and an estimated error below "
        f"{ERROR_LIMIT:g}, and a pole further from the unit circle than rounding can move it. "
        "There may be no stabilising solution; look for modes near the unit circle that are barely "
        "driven or seen.",
        status="residual",
        residual=residual if stable else None,
    )


def require_seen(
    A: FloatArray, C: FloatArray, words: str, *, drive: FloatArray, only_unit_circle: bool = False
) -> None:
    """Raise with words for a mode of A that does not decay and that C does not see.

    The Popov-Belevitch-Hautus test on the eigenvalues with modulus 1 or more
    (or about 1, with ``only_unit_circle``). ``drive`` (n, p), which enters the states,
    serves to scale them, because the answer must not depend on their units. The words have places
    for the mode, and for the states that it is made of.
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
        _, sizes, directions = np.linalg.svd(pencil)
        if sizes[-1] < tolerance:
            is_real = abs(point.imag) <= 1e-9 * abs(point)
            mode = f"{point.real + 0.0:.6g}" if is_real else f"{point:.6g}"
            vector = np.abs(units * directions[-1])
            raise DetectabilityError(
                words.format(mode=mode, states=_largest_states(vector)),
                eigenvalue=point,
                eigenvector=frozen_copy(vector / np.linalg.norm(vector)),
            )


def _largest_states(vector: FloatArray) -> str:
    """Name the few states that have the largest part in a mode."""
    share = vector / np.max(vector)
    order = [int(i) for i in np.argsort(-share) if share[i] > _NOTHING]
    named = ", ".join(f"{i} ({share[i]:.3g})" for i in order[:4])
    return named + (", ..." if len(order) > 4 else "")


def require_stabilising(equations: Equations, index: int, name: str = "") -> None:
    """Raise if an equation has no stabilising solution for a reason that can be named."""
    A, B, Q, R, S = (getattr(equations, key)[index] for key in "ABQRS")
    words = (
        f"{name}(A, B) must be stabilisable; the mode of A at {{mode}} does not decay and B does "
        "not reach it. Give it an input, or take it out of the model."
    )
    require_seen(A.T, B.T, words, drive=weight_root(Q))
    inputs = np.vstack([part / max(np.abs(part).max(), 1e-300) for part in (B, R, S)])
    if np.linalg.svd(inputs, compute_uv=False)[-1] < _RANK:
        raise DefinitenessError(
            f"{name}R must be positive definite, or B and S must act where it is not; got a "
            "combination of inputs that has no weight and no effect. Leave it out."
        )
    if np.linalg.eigvalsh(R)[0] > 0:
        feedback = np.linalg.solve(R, S.T)
        weight = Q - S @ feedback
        words = (
            f"{name}Q must see every mode on the unit circle; the mode of A at {{mode}} has no "
            "weight, so there is no stabilising solution. Add a small weight on it."
        )
        root = weight_root((weight + weight.T) / 2).T
        require_seen(A - B @ feedback, root, words, drive=B, only_unit_circle=True)


def weight_root(weight: FloatArray) -> FloatArray:
    """Columns whose squares add up to the absolute value of a symmetric matrix."""
    values, vectors = np.linalg.eigh(weight)
    size = np.abs(values)
    size = np.where(size > 1e-14 * size.max(initial=0.0), size, 0.0)  # a root doubles its digits
    return np.asarray(vectors * np.sqrt(size), dtype=np.float64)
