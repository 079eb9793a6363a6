"""One call to the conic solver, and its answer as plain arrays."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import cvxpy as cp

from lbt_synth.errors import NumericalError
from lbt_synth.linear.infeasibility_proof import Witness
from lbt_synth.validation import FloatArray

# Tighter ones end as "optimal_inaccurate" on plants with two equal axes, and gain nothing.
_SETTINGS = {"tol_gap_abs": 1e-8, "tol_gap_rel": 1e-8, "tol_feas": 1e-8, "max_iter": 200}
# Close to the edge of what is feasible it loses its accuracy, now with its own scaling of the
# programme, now without: the next one is tried.
_ATTEMPTS: tuple[dict[str, Any], ...] = (
    {},
    {"equilibrate_enable": False},
    {"static_regularization_constant": 1e-9},
)
USABLE = ("optimal", "optimal_inaccurate")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LmiSolution:
    """A solved semidefinite programme, back in the problem's own coordinates."""

    gamma: float  # Level of the programme (infinite for the Kalman filter)
    P: FloatArray  # (n, n): covariance, or ``gamma^2`` times the inverse of the storage matrix
    # gain_predictor, gain_filter (n, q): gains in closed form from P
    gain_predictor: FloatArray
    gain_filter: FloatArray
    status: str  # The solver's word; no evidence, so the design is certified without it
    iterations: int  # Iterations of the solver
    # The dual solution, as disturbances that no filter sees (of the least gamma only)
    witness: Witness | None = None


def symmetrised(expression: Any) -> Any:
    """Return (M + M') / 2, so that rounding does not trouble the modelling layer."""
    return (expression + expression.T) / 2


def _unsolved(reason: str) -> NumericalError:
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
            with warnings.catch_warnings():
                # an inaccurate solution is judged by the certificate, not by a warning
                warnings.filterwarnings("ignore", message="Solution may be inaccurate")
                programme.solve(solver=cp.CLARABEL, **_SETTINGS, **settings)
            break
        except cp.error.SolverError as error:
            if attempt == len(_ATTEMPTS) - 1:
                raise _unsolved("the solver lost its accuracy on the way.") from error
        except ValueError as error:  # what cvxpy raises on data that are not finite
            raise _unsolved("its numbers are not finite.") from error
        except BaseException as error:
            # what the compiled solver raises on numbers out of all range is no Exception
            if type(error).__name__ != "PanicException":
                raise
            raise _unsolved("the solver gave up on numbers out of its range.") from error
    iterations = programme.solver_stats.num_iters if programme.solver_stats else 0
    return str(programme.status), int(iterations or 0)
