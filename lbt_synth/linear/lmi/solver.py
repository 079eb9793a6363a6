"""Call the conic solver, and refuse what it did not solve."""

from __future__ import annotations

from typing import Any

import cvxpy as cp

from lbt_synth.errors import NumericalError
from lbt_synth.storage.warning_filters import ignore_warnings

# Tighter tolerances end as "optimal_inaccurate" on plants with two equal axes, and gain nothing.
_SETTINGS = {"tol_gap_abs": 1e-8, "tol_gap_rel": 1e-8, "tol_feas": 1e-8, "max_iter": 200}
# Near the edge of feasibility the solver loses its accuracy, sometimes with its own scaling of
# the programme and sometimes without. These settings are tried in turn.
_ATTEMPTS: tuple[dict[str, Any], ...] = (
    {},
    {"equilibrate_enable": False},
    {"static_regularization_constant": 1e-9},
)
USABLE = ("optimal", "optimal_inaccurate")


def symmetrise(expression: Any) -> Any:
    """Return ``(M + M') / 2``, because cvxpy refuses a matrix that rounding made asymmetric."""
    return (expression + expression.T) / 2


def _solver_error(reason: str) -> NumericalError:
    return NumericalError(
        f"the conic programme was not solved: {reason} Try slightly different bounds, or another "
        "number of taps or functions; for kalman and hinf, the Riccati route.",
        status="solver error",
    )


def solve(objective: Any, constraints: list[Any]) -> tuple[str, int]:
    """Solve with Clarabel; return the status and the iteration count."""
    programme = cp.Problem(objective, constraints)
    for attempt, settings in enumerate(_ATTEMPTS):
        try:
            # the certificate judges an inaccurate solution, not a warning
            with ignore_warnings(message="Solution may be inaccurate"):
                programme.solve(solver=cp.CLARABEL, **_SETTINGS, **settings)
            break
        except cp.error.SolverError as error:
            if attempt == len(_ATTEMPTS) - 1:
                raise _solver_error("the solver lost its accuracy on the way.") from error
        except ValueError as error:  # raised by cvxpy on data that are not finite
            raise _solver_error("its numbers are not finite.") from error
        except BaseException as error:
            # on numbers out of range the compiled solver raises something other than an Exception
            if type(error).__name__ != "PanicException":
                raise
            raise _solver_error("the solver gave up on numbers out of its range.") from error
    iterations = programme.solver_stats.num_iters if programme.solver_stats else 0
    return str(programme.status), int(iterations or 0)


def require_optimum(run: tuple[str, int], programme: str, advice: str) -> None:
    """Refuse a programme whose status is not that of an optimum."""
    if run[0] not in USABLE:
        raise NumericalError(
            f"{programme} ended as {run[0]!r}; expected an optimum. {advice}", status=run[0]
        )
