"""Conic programmes given to the solver as arrays, and functions of a Youla parameter as such.

Loop shaping solves many programmes a design, and cvxpy takes longer to build each than Clarabel to
solve it. All other programmes are stated in cvxpy.

A function with denominators (at another gain of the loop than the nominal one) is not convex.
At the current coefficients it is replaced by a convex model: to second order where squares are
summed, with ``r = a / b``, slopes ``J`` of r and ``beta`` of ``log b``::

    |r|^2 ~ |r0|^2 + 2 Re(conj(r0) J d) + |J d|^2 - 2 Re(conj(r0) (beta d) (J d))

to first order, ``|r0 + J d|``, where the largest counts. Directions in which the sum of squares
bends down keep a part of ``|J d|^2``. Demands are imposed as they are: they are convex, and keep
the loop in its stable set. A step along the model's minimum that lowers the function itself, and
Newton's method with it, ends at a local minimum (sequential convex programming: Q. Tran Dinh,
M. Diehl, in "Recent Advances in Optimization and its Applications in Engineering" (2010),
doi:10.1007/978-3-642-12598-0_9).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeAlias

import clarabel
import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from lbt_synth.errors import NumericalError
from lbt_synth.linear.convex_functions import Constraint, Discs, Fractions, Function, HalfPlanes
from lbt_synth.linear.matrix_functions import semidefinite_root
from lbt_synth.validation import ComplexArray, FloatArray

_LEAST_CURVATURE = 0.03  # of that of the slopes alone
_FLAT = 1e-12  # part of the largest curvature below which a direction is flat
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


@contextmanager
def refused_panic() -> Iterator[None]:
    """Refuse a programme whose numbers are out of range: there the compiled solver panics."""
    try:
        yield
    except BaseException as error:  # a panic is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise solver_error("the solver gave up on numbers out of its range.") from error


def require_optimum(run: tuple[str, int], programme: str, advice: str) -> None:
    """Refuse a programme whose status is not that of an optimum."""
    if run[0] not in USABLE:
        raise NumericalError(
            f"{programme} ended as {run[0]!r}; expected an optimum. {advice}", status=run[0]
        )


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

    def minimize(
        self, linear: FloatArray, quadratic: FloatArray | None = None
    ) -> tuple[FloatArray, tuple[str, int]]:
        """Solve for q, (n,), and P, (n, n); return x, and the status and count of iterations."""
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
            with refused_panic():
                answer = clarabel.DefaultSolver(
                    sparse.csc_matrix(P), linear, A, b, self._cones, settings
                ).solve()
            status = _STATUS.get(str(answer.status))
            if status is not None:
                return np.array(answer.x), (status, int(answer.iterations))
        raise solver_error("the solver lost its accuracy on the way.")


def minimize(
    function: Function,
    constraints: tuple[Constraint, ...],
    *,
    size: int,
    scale: float,
    start: FloatArray | None = None,
) -> tuple[FloatArray | None, str]:
    """Minimise a function; one with denominators by its convex model at ``start``, (size,).

    Return the coefficients, None if the constraints cannot hold together, and the solver's status.
    """
    origin = np.zeros(size) if start is None else start
    programme = ConicProgramme(size + sum(part.worst for part in function))
    for constraint in constraints:
        _constrain(programme, constraint, origin)
    linear, roots = _state(programme, function, origin, scale)
    x, (status, _) = programme.minimize(linear, 2 * roots.T @ roots)
    return origin + x[:size] if status in USABLE else None, status


def minimize_relaxation(
    groups: tuple[tuple[Constraint, ...], ...], *, size: int, rigid: tuple[bool, ...]
) -> FloatArray:
    """Find by how much groups of constraints must be relaxed to hold together, (groups,).

    Each bound is multiplied by 1 plus the number of its group, which is 0 for ``rigid`` groups.
    """
    count = len(groups)
    programme, origin = ConicProgramme(size + count), np.zeros(size)
    slack = np.r_[np.zeros(size), np.ones(count)]
    programme.add_nonnegative(np.eye(size + count)[size:], np.zeros(count))
    for i, group in enumerate(groups):
        for constraint in group:
            _constrain(programme, constraint, origin, None if rigid[i] else size + i)
    x, run = programme.minimize(slack)
    if "infeasible" in run[0]:
        return np.full(count, np.inf)
    require_optimum(
        run,
        "the search for constraints that clash",
        "They may be close to what can be met, or very far from it; relax them, or try another "
        "number of functions.",
    )
    return np.where(rigid, 0.0, x[size:])


def _state(
    programme: ConicProgramme, function: Function, origin: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """State a convex model ``linear x + |roots x|^2`` of a step from an origin, over its scale."""
    linear, roots, n = np.zeros(programme.size), [], origin.size
    level = iter(np.eye(programme.size)[n:])  # of a part of which the largest fraction counts
    for fractions in function:
        if fractions.worst:
            values, slopes, _ = _expand(fractions, origin)
            unit, bound = 1 / np.sqrt(scale), next(level)
            _bound_norms(programme, values * unit, slopes * unit, bound, 0.0)
            roots.append(bound[None])
        else:
            gradient, hessian = _second_order(fractions, origin)
            linear[:n] += gradient / scale
            root = semidefinite_root(hessian / scale).T
            roots.append(np.pad(root, ((0, 0), (0, programme.size - n))))
    return linear, np.concatenate(roots)


def _expand(
    function: Fractions, c: FloatArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray | None]:
    """Quotients (F, r) of a function at c, their slopes (F, r, n), and those of log b (F, n)."""
    b = function.denominators(c)
    values = (function.centres + function.rows @ c) / b[:, None]
    slopes = function.rows / b[:, None, None]
    if function.steering is None:
        return values, slopes, None
    turn = -function.steering / b[:, None]
    return values, slopes - values[..., None] * turn[:, None], turn


def _second_order(function: Fractions, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient, and half the Hessian made positive, of a sum of squares at c."""
    values, slopes, turn = _expand(function, c)
    n = c.size
    J, r = slopes.reshape(-1, n), values.ravel()
    gradient = 2 * np.real(r.conj() @ J)
    real_slopes = np.concatenate([J.real, J.imag])
    hessian = real_slopes.T @ real_slopes
    if turn is None:
        return gradient, hessian
    steered = np.einsum("fr,frn->fn", values.conj(), slopes)
    bend = -np.real(turn.T @ steered)
    bend = bend + bend.T
    # relative to the slopes alone, so that units do not matter
    floor = _FLAT * float(np.trace(hessian))
    parts, basis = eigh(bend, hessian + floor * np.eye(n))
    back = (hessian + floor * np.eye(n)) @ basis
    return gradient, np.asarray((back * np.maximum(1 + parts, _LEAST_CURVATURE)) @ back.T)


def _constrain(
    programme: ConicProgramme, constraint: Constraint, origin: FloatArray, slack: int | None = None
) -> None:
    """Require a constraint of ``origin + step``, its bound times 1 plus an unknown if given."""
    more = np.zeros(programme.size)
    if slack is not None:
        more[slack] = 1.0
    if isinstance(constraint, HalfPlanes):
        rows = constraint.rows / constraint.bounds[:, None]
        held = more - np.pad(rows, ((0, 0), (0, programme.size - origin.size)))
        programme.add_nonnegative(held, 1 - rows @ origin)
    elif isinstance(constraint, Discs):
        turns = constraint.rows / constraint.radii[:, None]
        centres = constraint.centres / constraint.radii + turns @ origin
        _bound_norms(programme, centres[:, None], turns[:, None], more, 1.0)
    else:
        # sum |centres + rows c|^2 = ||root c - target||^2
        slopes, centres = constraint.function.rows, constraint.function.centres
        system = np.hstack([slopes.reshape(-1, origin.size), -centres.reshape(-1, 1)])
        triangle = np.asarray(np.linalg.qr(np.vstack([system.real, system.imag]), mode="r"))
        root, target = triangle[:, :-1], triangle[:, -1]
        unit = 1 / np.sqrt(constraint.limit)
        _bound_norms(programme, unit * (root @ origin - target)[None], unit * root[None], more, 1.0)


def _bound_norms(
    programme: ConicProgramme,
    centres: ComplexArray | FloatArray,
    rows: ComplexArray | FloatArray,
    slopes: FloatArray,
    offset: float,
) -> None:
    """``sqrt(sum over r |centres + rows step|^2) <= offset + slopes x`` at each frequency."""
    n = rows.shape[-1]
    parts = np.concatenate([rows.real, rows.imag], axis=1)
    inner = np.pad(parts, ((0, 0), (1, 0), (0, slopes.size - n))).astype(np.float64)
    inner[:, 0] = slopes
    values = np.concatenate([centres.real, centres.imag], axis=1)
    offsets = np.pad(values, ((0, 0), (1, 0)), constant_values=offset).astype(np.float64)
    programme.add_second_order(inner.reshape(-1, slopes.size), offsets)
