"""The settings of the conic solver, and programmes given to it as arrays.

Loop shaping solves many programmes a design, and cvxpy takes longer to build each than Clarabel to
solve it. All others are stated in cvxpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import clarabel
import numpy as np
from scipy import sparse

from lbt_synth.errors import NumericalError
from lbt_synth.validation import FloatArray

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
    status: str
    iterations: int


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
                return ConicSolution(np.array(found.x), status, int(found.iterations))
        raise solver_error("the solver lost its accuracy on the way.")
