"""Conic programmes as arrays, given to Clarabel directly.

A model of cvxpy takes longer to build than a small programme takes to solve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import clarabel
import numpy as np
from scipy import sparse

from lbt_synth.errors import NumericalError
from lbt_synth.validation import FloatArray, IntArray

# Tighter tolerances end as "optimal_inaccurate" on plants with two equal axes, and gain nothing.
SETTINGS = {"tol_gap_abs": 1e-8, "tol_gap_rel": 1e-8, "tol_feas": 1e-8, "max_iter": 200}
# Near the edge of feasibility the solver loses its accuracy, sometimes with its own scaling of
# the programme and sometimes without. These settings are tried in turn.
ATTEMPTS: tuple[dict[str, bool | float], ...] = (
    {},
    {"equilibrate_enable": False},
    {"static_regularization_constant": 1e-9},
)
Rows: TypeAlias = FloatArray | sparse.csr_matrix
USABLE = ("optimal", "optimal_inaccurate")
_STATUS = {
    "Solved": "optimal",
    "AlmostSolved": "optimal_inaccurate",
    "PrimalInfeasible": "infeasible",
    "AlmostPrimalInfeasible": "infeasible_inaccurate",
    "DualInfeasible": "unbounded",
    "AlmostDualInfeasible": "unbounded_inaccurate",
    "MaxIterations": "user_limit",
}


def solver_error(reason: str) -> NumericalError:
    """Error of a programme that the solver gave up on."""
    return NumericalError(
        f"the conic programme was not solved: {reason} Try slightly different bounds, or another "
        "number of taps or functions; for kalman and hinf, the Riccati route.",
        status="solver error",
    )


def require_optimum(run: tuple[str, int], programme: str, advice: str) -> None:
    """Refuse a programme whose status is not that of an optimum."""
    if run[0] not in USABLE:
        raise NumericalError(
            f"{programme} ended as {run[0]!r}; expected an optimum. {advice}", status=run[0]
        )


@dataclass(frozen=True, slots=True, eq=False)
class ConicSolution:
    """What the solver found."""

    x: FloatArray  # (n,)
    dual: FloatArray  # multipliers of all rows, in the order in which they were added
    status: str
    iterations: int


def _triangle(d: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Return rows, columns and scales of the upper triangle as the solver has it, by columns."""
    column, row = np.tril_indices(d)
    return row, column, np.where(row == column, 1.0, np.sqrt(2))


def dual_matrix(multipliers: FloatArray) -> FloatArray:
    """Return the multiplier of a symmetric matrix, (d, d), from those of its rows."""
    d = int(np.sqrt(2 * multipliers.size))
    row, column, scale = _triangle(d)
    matrix = np.zeros((d, d))
    matrix[row, column] = matrix[column, row] = multipliers / scale
    return matrix


class SymmetricUnknown:
    """A symmetric matrix whose upper triangle is unknown, by rows, between rows of one part."""

    def __init__(self, parts: IntArray) -> None:
        self.n = len(parts)
        self.row, self.column = np.nonzero(np.triu(parts[:, None] == parts))
        self.trace = np.where(self.row == self.column, 1.0, 0.0)
        self.size = self.row.size

    def congruence(self, M: FloatArray) -> FloatArray:
        """Return the rows (d, d, size) of ``M P M'``, with M (d, n)."""
        left, right = M[:, self.row], M[:, self.column]
        half = left[:, None] * right * np.where(self.row == self.column, 0.5, 1.0)
        return np.asarray(half + half.swapaxes(0, 1))

    def matrix(self, x: FloatArray) -> FloatArray:
        """Return the matrix of the unknowns (size,)."""
        matrix = np.zeros((self.n, self.n))
        matrix[self.row, self.column] = matrix[self.column, self.row] = x
        return matrix


class ConicProgramme:
    """Minimise ``x'P x / 2 + q'x``, with ``offsets + rows x`` in cones."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._cones: list[object] = []
        self._rows: list[sparse.csr_matrix] = []
        self._offsets: list[FloatArray] = []

    def add_nonnegative(self, rows: Rows, offsets: FloatArray) -> None:
        """Require ``offsets + rows x >= 0``, (m, n) and (m,)."""
        self._add(rows, offsets, [clarabel.NonnegativeConeT(len(offsets))])

    def add_second_order(self, rows: Rows, offsets: FloatArray) -> None:
        """Require of each of k vectors, (k d, n) and (k, d), that its first entry is a bound.

        The bound is on the Euclidean norm of the others.
        """
        count, length = offsets.shape
        self._add(rows, offsets.ravel(), [clarabel.SecondOrderConeT(length)] * count)

    def add_semidefinite(self, rows: sparse.csr_matrix, offsets: FloatArray) -> None:
        """Require of each of k symmetric matrices, (k d d, n) and (k, d, d), that it is >= 0."""
        count, d, _ = offsets.shape
        row, column, scale = _triangle(d)
        scale = np.tile(scale, count)
        at = (np.arange(count)[:, None] * d * d + row * d + column).ravel()
        cones = [clarabel.PSDTriangleConeT(d)] * count
        self._add(sparse.diags(scale) @ rows[at], scale * offsets.ravel()[at], cones)

    def _add(self, rows: Rows, offsets: FloatArray, cones: list[object]) -> None:
        self._rows.append(sparse.csr_matrix(rows))
        self._offsets.append(offsets)
        self._cones += cones

    def minimize(self, linear: FloatArray, quadratic: FloatArray | None = None) -> ConicSolution:
        """Solve for q, (n,), and P, (n, n)."""
        blocks = [sparse.csr_matrix((0, self.size)), *self._rows]
        A = -sparse.vstack(blocks, format="csc")
        b = np.concatenate([np.zeros(0), *self._offsets])
        P = np.zeros((self.size, self.size)) if quadratic is None else np.triu(quadratic)
        if not all(np.all(np.isfinite(part)) for part in (A.data, b, P, linear)):
            raise solver_error("its numbers are not finite.")
        for attempt in ATTEMPTS:
            settings = clarabel.DefaultSettings()
            settings.verbose = False
            for name, value in {**SETTINGS, **attempt}.items():
                setattr(settings, name, value)
            try:
                found = clarabel.DefaultSolver(
                    sparse.csc_matrix(P), linear, A, b, self._cones, settings
                ).solve()
            except BaseException as error:
                # on numbers out of range the compiled solver raises something else
                if type(error).__name__ != "PanicException":
                    raise
                raise solver_error("the solver gave up on numbers out of its range.") from error
            status = _STATUS.get(str(found.status))
            if status is not None:
                x, dual = np.array(found.x), np.array(found.z)
                return ConicSolution(x, dual, status, int(found.iterations))
        raise solver_error("the solver lost its accuracy on the way.")
