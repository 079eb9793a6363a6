"""Conic programmes that minimise functions of the coefficients of a Youla parameter.

A function with denominators (at another gain of the loop than the nominal one) is not convex.
It is replaced by a convex function that lies above it and touches it at the current
coefficients c0. With ``b = 1 - steering c`` and its value b0 at c0::

    |b|^2 >= l(b) = 2 Re(conj(b0) b) - |b0|^2,    so    |a|^2 / |b|^2 <= |a|^2 / l(b)

Minimising the right-hand side lowers the function, and its domain keeps b in the half-plane
of b0 at every frequency of the programme, so the loop does not leave its stable set (the
convex-concave procedure; A. L. Yuille, A. Rangarajan, Neural Comput. 15, 915 (2003),
doi:10.1162/08997660360581958).
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from lbt_synth.linear.convex_functions import (
    CombinedFunction,
    Constraint,
    Discs,
    Fractions,
    Function,
    FunctionBound,
    HalfPlanes,
)
from lbt_synth.linear.lmi.conic_data import USABLE, require_optimum
from lbt_synth.linear.lmi.solver import solve
from lbt_synth.validation import ComplexArray, FloatArray


def minimize(
    function: Function,
    constraints: tuple[Constraint, ...],
    *,
    size: int,
    scale: float,
    start: FloatArray | None = None,
) -> tuple[FloatArray | None, str]:
    """Minimise a function; one with denominators by its convex majorant at ``start``, (size,).

    Return the coefficients, None if the constraints cannot hold together, and the solver's status.
    """
    c = cp.Variable(size)
    objective = _Objective(c, scale, start)
    goal = cp.Minimize(objective.expression(function))
    for constraint in constraints:
        objective.needs += _as_constraints(constraint, c, 0.0)
    status, _ = solve(goal, objective.needs)
    return (np.asarray(c.value, dtype=np.float64) if status in USABLE else None), status


def minimize_relaxation(
    groups: tuple[tuple[Constraint, ...], ...], *, size: int, rigid: tuple[bool, ...]
) -> FloatArray:
    """Find by how much groups of constraints must be relaxed to hold together, (groups,).

    Each bound is multiplied by 1 plus the number of its group, which is 0 for ``rigid`` groups.
    """
    c, slack = cp.Variable(size), cp.Variable(len(groups), nonneg=True)
    held: list[cp.Constraint] = []
    for i, group in enumerate(groups):
        for constraint in group:
            held += _as_constraints(constraint, c, 0.0 if rigid[i] else slack[i])
    run = solve(cp.Minimize(cp.sum(slack)), held)
    if "infeasible" in run[0]:
        return np.full(len(groups), np.inf)
    require_optimum(
        run,
        "the search for constraints that clash",
        "They may be close to what can be met, or very far from it; relax them, or try another "
        "number of functions.",
    )
    return np.asarray(np.where(rigid, 0.0, slack.value), dtype=np.float64)


class _Objective:
    """Convex expressions of functions over their scale, and the constraints that they need."""

    def __init__(self, c: cp.Variable, scale: float, start: FloatArray | None) -> None:
        self.c, self.scale, self.start = c, scale, start
        self.needs: list[cp.Constraint] = []

    def expression(self, function: Function) -> cp.Expression:
        """Return the expression of a function."""
        if isinstance(function, CombinedFunction):
            pairs = zip(function.weights, function.parts, strict=True)
            parts = [weight * self.expression(part) for weight, part in pairs]
            return cp.maximum(*parts) if function.worst and len(parts) > 1 else cp.sum(parts)
        if function.steering is not None:
            return self._majorant(function, function.steering)
        unit = 1 / np.sqrt(self.scale)
        if function.worst:
            level = cp.Variable(nonneg=True)
            centres, rows = function.centres * unit, function.rows * unit
            self.needs.append(_norm_bounds(level, centres, rows, self.c))
            return cp.square(level)
        root, target = _least_squares_form(function)
        return cp.sum_squares(unit * root @ self.c - unit * target)

    def _majorant(self, function: Fractions, steering: ComplexArray) -> cp.Expression:
        """Convex upper bound of a function with denominators that touches it at the start."""
        assert self.start is not None  # such a function is minimised from a start
        b0, a0 = function.denominators(self.start), np.sqrt(function.numerators(self.start))
        values = a0**2 / np.abs(b0) ** 2
        # 2 Re(conj(b0) b) - |b0|^2 over |b0|^2: one at the start
        slopes = np.real(-2 * b0.conj()[:, None] * steering) / np.abs(b0[:, None]) ** 2
        denominators = (1 - slopes @ self.start) + slopes @ self.c
        # each fraction in units of its own value, but not of a vanishing one
        sizes = np.maximum(values, max(1e-9 * float(np.max(values)), 1e-12 * self.scale))
        largest = float(np.max(sizes))
        unit = np.sqrt(sizes) * np.abs(b0)
        centres, rows = function.centres / unit[:, None], function.rows / unit[:, None, None]
        stacked = _real_parts(centres, rows, self.c)
        if function.worst:
            level: cp.Expression = cp.Variable(nonneg=True)
            # in units of the largest value
            ratio = np.sqrt(sizes / largest)
            stacked = cp.multiply(stacked, np.broadcast_to(ratio, stacked.shape))
            levels: cp.Expression = level * np.ones(len(b0))
            total = level * (largest / self.scale)
        else:
            levels = cp.Variable(len(b0), nonneg=True)
            total = (sizes / self.scale) @ levels
        difference = cp.reshape(levels - denominators, (1, len(b0)), order="C")
        self.needs.append(cp.SOC(levels + denominators, cp.vstack([2 * stacked, difference])))
        return total


def _as_constraints(
    constraint: Constraint, c: cp.Variable, slack: float | cp.Expression
) -> list[cp.Constraint]:
    """Constraints of the programme, with the bound times ``1 + slack``."""
    if isinstance(constraint, HalfPlanes):
        unit = 1 / constraint.bounds
        return [cp.multiply(unit, constraint.rows @ c) <= 1 + slack]
    if isinstance(constraint, Discs):
        unit = (1 / constraint.radii)[:, None]
        rows = constraint.rows[:, None, :] * unit[..., None]
        return [_norm_bounds(1 + slack, constraint.centres[:, None] * unit, rows, c)]
    assert isinstance(constraint, FunctionBound)
    root, target = _least_squares_form(constraint.function)
    unit = 1 / np.sqrt(constraint.limit)
    return [cp.norm(unit * root @ c - unit * target) <= 1 + slack]


def _norm_bounds(
    level: float | cp.Expression, centres: ComplexArray, rows: ComplexArray, c: cp.Variable
) -> cp.Constraint:
    """``sqrt(sum over r |centres + rows c|^2) <= level`` at each frequency."""
    return cp.SOC(level * np.ones(len(centres)), _real_parts(centres, rows, c))


def _real_parts(centres: ComplexArray, rows: ComplexArray, c: cp.Variable) -> cp.Expression:
    """Real and imaginary parts of the responses, (2 r, F)."""
    parts = []
    for i in range(centres.shape[1]):
        centre, row = centres[:, i], rows[:, i]
        parts += [centre.real + row.real @ c, centre.imag + row.imag @ c]
    return cp.vstack(parts)


def _least_squares_form(function: Fractions) -> tuple[FloatArray, FloatArray]:
    """Root and target with ``sum |centres + rows c|^2 = ||root c - target||^2``."""
    size = function.rows.shape[-1]
    rows = function.rows.reshape(-1, size)
    whole = np.hstack([rows, -function.centres.reshape(-1, 1)])
    triangle = np.asarray(np.linalg.qr(np.vstack([whole.real, whole.imag]), mode="r"))
    return triangle[:, :size], triangle[:, size]
