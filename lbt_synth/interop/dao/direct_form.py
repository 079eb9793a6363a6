"""The direct form of a dao real-time computer: a controller's matrix, and a matrix in the loop.

Per mode ``u(k) = b_0 y(k) + .. + b_M y(k-M) + a_1 u(k-1) + .. + a_M u(k-M)``; rows ``0 .. M`` of a
matrix (2 M + 1, modes) are b, rows ``M+1 .. 2M`` are a.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from lbt_synth.errors import DimensionError, NumericalError, ProblemError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.validation import FloatArray, frozen_copy

_COUPLED = 1e-9  # of the largest entry of a matrix; less is what a solver leaves of a zero
_NEGLIGIBLE = 1e-13  # of the largest coefficient; single precision has no use for less


def direct_form_rows(controller: Controller, order: int) -> FloatArray:
    """Return the matrix (2 order + 1, modes) of a controller, before it is rounded."""
    rows = np.zeros((2 * order + 1, len(controller.C)))
    for mode, (num, den) in enumerate(mode_polynomials(controller)):
        needed = len(den) - 1
        if needed > order:
            raise ProblemError(
                f"order must be at least {needed}, that of the controller of mode {mode + 1}; got "
                f"{order}. Raise it there and in the RTC's configuration, or design with fewer "
                "states."
            )
        rows[: needed + 1, mode] = num
        rows[order + 1 : order + 1 + needed, mode] = -den[1:]
    return rows


def mode_polynomials(controller: Controller) -> list[tuple[FloatArray, FloatArray]]:
    """Return numerator and denominator (k,) of each mode in powers of ``z^-1``.

    States that a mode does not drive, or does not show in its command, are left out. Denominators
    begin with 1.
    """
    system, size = controller.to_statespace().balanced(), controller.n_states
    if system.D.shape[0] != system.D.shape[1]:
        raise ProblemError(
            f"a filter per mode needs as many commands as measurements; got {len(system.C)} "
            f"commands and {system.B.shape[1]} measurements. Use a target of matrices, such as c."
        )
    A, B, C, D = (_links(getattr(system, name)) for name in "ABCD")
    paths = np.linalg.matrix_power(A | np.eye(size, dtype=np.bool_), size)
    reached, shown = paths @ B, C @ paths
    coupled = np.argwhere((D | (C @ reached)) & ~np.eye(len(D), dtype=np.bool_))
    if coupled.size:
        raise ProblemError(
            f"the modes must decouple; here measurement {coupled[0, 1] + 1} moves command "
            f"{coupled[0, 0] + 1}. Use a target of matrices, such as c."
        )
    inside = [np.flatnonzero(reached[:, mode] & shown[mode]) for mode in range(len(D))]
    return [_polynomials(system, mode, states) for mode, states in enumerate(inside)]


def _characteristic(A: FloatArray) -> FloatArray:
    """Return the characteristic polynomial, highest power first."""
    if not A.size:
        return np.ones(1)
    finite = bool(np.all(np.isfinite(A)))
    return np.asarray(np.real(np.poly(A))) if finite else np.full(len(A) + 1, np.nan)


def _links(matrix: FloatArray) -> NDArray[np.bool_]:
    """Return which entries couple, (rows, columns)."""
    return np.asarray(np.abs(matrix) > _COUPLED * np.max(np.abs(matrix), initial=0.0))


def _polynomials(
    system: StateSpace, mode: int, states: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Return the quotient ``c adj(zI - A) b / det(zI - A) + d`` of some states of a mode."""
    A = system.A[np.ix_(states, states)]
    b, c, d = system.B[states, mode], system.C[mode, states], system.D[mode, mode]
    with np.errstate(all="ignore"):  # what overflows is refused once it is rounded
        den, entry = _characteristic(A), np.outer(b, c)
        scale = 1 / (np.max(np.abs(entry), initial=0.0) or 1.0)
        # det(zI - A + b c) = det(zI - A) + c adj(zI - A) b
        num = d * den + (_characteristic(A - scale * entry) - den) / scale
        shares = [np.abs(part) / (np.max(np.abs(part)) or 1.0) for part in (num, den)]
    used = ~(np.max(shares, axis=0) <= _NEGLIGIBLE)  # what is no number is used, and refused
    count = 1 + int(np.flatnonzero(used)[-1])
    return num[:count], den[:count]


def direct_form(rows: FloatArray, dt_s: float) -> Controller:
    """Return the controller of a matrix (2 M + 1, modes), whose first states are the commands."""
    if not np.all(np.isfinite(rows)):
        raise NumericalError(
            "the coefficients must be numbers of single precision; some are beyond its range. "
            "Try a target that keeps the states (c, matlab), or a design with fewer states.",
            status="overflow",
        )
    order, modes = len(rows) // 2, rows.shape[1]
    step = np.eye(order + 1, k=1)  # x_j(k) = x_{j+1}(k-1) + b_j y(k) + a_j u(k-1)
    feedback = np.vstack([rows[order + 1 :], np.zeros((1, modes))])
    return Controller(
        A=block_diag(*(step + np.outer(a, np.eye(1, order + 1)) for a in feedback.T)),
        B=block_diag(*rows[: order + 1].T[:, :, None]),
        C=frozen_copy(np.kron(np.eye(modes), np.eye(1, order + 1))),
        D=np.zeros((modes, modes)),
        dt_s=dt_s,
    )


class InnerLoop:
    """Per mode, ``u(k) = sum b_j y(k-j) + sum a_i u(k-i)``, in single precision.

    The products are added one by one, in the order of the matrix's rows. The voltages are
    ``-to_actuators u``; where one exceeds the limit it is clipped, and the memory holds the
    commands that were applied.

    The matrix (2 M + 1, modes) has rows ``b_0 .. b_M``, then ``a_1 .. a_M``; ``to_actuators``
    (actuators, modes) is the identity by default, and the limit that of a voltage's modulus.
    """

    def __init__(
        self,
        matrix: ArrayLike,
        to_actuators: ArrayLike | None = None,
        limit: float = np.inf,
    ) -> None:
        self._rows = np.asarray(matrix, dtype=np.float32)
        if self._rows.ndim != 2 or len(self._rows) % 2 == 0:
            raise DimensionError(
                "the matrix must have 2 M + 1 rows and one column per mode; got shape "
                f"{self._rows.shape}."
            )
        modes = self._rows.shape[1]
        given = np.eye(modes) if to_actuators is None else to_actuators
        self._to_actuators = np.asarray(given, dtype=np.float32)
        if self._to_actuators.ndim != 2 or self._to_actuators.shape[1] != modes:
            raise DimensionError(
                f"to_actuators must have {modes} columns, one per mode; got shape "
                f"{self._to_actuators.shape}."
            )
        self._to_modes = np.linalg.pinv(self._to_actuators).astype(np.float32)
        self._limit = np.float32(limit)
        self._past = len(self._rows) // 2  # M
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._memory: NDArray[np.float32] = np.zeros_like(self._rows)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (modes,), return the commands that were applied, (modes,)."""
        memory, first = self._memory, self._past + 1
        memory[1:first] = memory[: first - 1].copy()
        memory[0] = y
        u = np.add.accumulate(self._rows * memory, axis=0)[-1]
        voltages = -(self._to_actuators @ u)
        if np.any(np.abs(voltages) > self._limit):
            u = -(self._to_modes @ np.clip(voltages, -self._limit, self._limit))
        memory[first + 1 :] = memory[first:-1].copy()
        memory[first : first + 1] = u  # nothing to write at M = 0
        return np.asarray(u, dtype=np.float64)
