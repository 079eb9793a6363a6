"""What the convex programmes in cvxpy share: unknowns, a bound on a norm, and the solver."""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np

from lbt_synth.linear.lmi.conic_program import ATTEMPTS, SETTINGS, refused_panic, solver_error
from lbt_synth.storage.warning_filters import ignore_warnings
from lbt_synth.validation import IntArray


def symmetric_variable(parts: IntArray) -> Any:
    """Return a symmetric unknown (n, n) that is zero between rows of different parts, (n,)."""
    P = 0
    for part in np.unique(parts):
        rows = np.eye(len(parts))[:, parts == part]
        P = P + rows @ cp.Variable((rows.shape[1], rows.shape[1]), symmetric=True) @ rows.T
    return P


def symmetrise(expression: Any) -> Any:
    """Return ``(M + M') / 2``, because cvxpy refuses a matrix that rounding made asymmetric."""
    return (expression + expression.T) / 2


def norm_below(real: Any, imaginary: Any, level: Any) -> Any:
    """Return the constraint that a complex matrix has a spectral norm of at most a level."""
    block = cp.bmat([[real, -imaginary], [imaginary, real]])
    rows, columns = block.shape
    inequality = cp.bmat([[level * np.eye(rows), block], [block.T, level * np.eye(columns)]])
    return symmetrise(inequality) >> 0


def solve(objective: Any, constraints: list[Any]) -> tuple[str, int]:
    """Solve with Clarabel; return the status and the iteration count."""
    programme = cp.Problem(objective, constraints)
    for attempt, settings in enumerate(ATTEMPTS):
        try:
            # the certificate judges an inaccurate solution, not a warning
            with refused_panic(), ignore_warnings(message="Solution may be inaccurate"):
                programme.solve(solver=cp.CLARABEL, **SETTINGS, **settings)
            break
        except cp.error.SolverError as error:
            if attempt == len(ATTEMPTS) - 1:
                raise solver_error("the solver lost its accuracy on the way.") from error
        except ValueError as error:  # raised by cvxpy on data that are not finite
            raise solver_error("its numbers are not finite.") from error
    iterations = programme.solver_stats.num_iters if programme.solver_stats else 0
    return str(programme.status), int(iterations or 0)
