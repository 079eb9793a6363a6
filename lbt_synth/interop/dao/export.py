"""The target dao: the matrix that Durham's dao real-time computers load, one column per mode.

Per mode ``u(k) = b_0 y(k) + .. + b_M y(k-M) + a_1 u(k-1) + .. + a_M u(k-M)``, in rows b, then a.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.files.telemetry.time_filters import is_significant, transfer_function
from lbt_synth.interop.dao.refit import DirectFormLoop, make_again, mode_loops
from lbt_synth.interop.modes import ModeDesign
from lbt_synth.interop.pipeline import Arithmetic, Target
from lbt_synth.interop.proof import ROUNDOFF, Written, prove_written, sums_variance
from lbt_synth.linear import Controller
from lbt_synth.storage.array_file import fits_bytes, open_fits
from lbt_synth.validation import FloatArray, frozen_copy, integer

_Matrix: TypeAlias = NDArray[np.float32]
_NEGLIGIBLE = 1e-13  # of the largest coefficient; single precision has no use for less
_SIGN = "actuators = -M2V u; y and u in the units of the mode, with the mirror's sign"


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
    """Return numerator and denominator (k,) of each mode in the powers of ``z^-1`` it needs."""
    system, size = controller.to_statespace().balanced(), controller.n_states
    m, q = system.D.shape
    if m != q:
        raise ProblemError(
            f"a filter per mode needs as many commands as measurements; got {m} commands and {q} "
            "measurements. Use a target of matrices, such as c."
        )
    A, B, C, D = (is_significant(getattr(system, name)) for name in "ABCD")
    paths = np.linalg.matrix_power(A | np.eye(size, dtype=np.bool_), size)
    coupled = np.argwhere((D | (C @ paths @ B)) & ~np.eye(m, dtype=np.bool_))
    if coupled.size:
        raise ProblemError(
            f"the modes must decouple; here measurement {coupled[0, 1] + 1} moves command "
            f"{coupled[0, 0] + 1}. Design with --method robust, which controls each axis alone, or "
            "use a target of matrices, such as c."
        )
    return [_shortened(*transfer_function(system, mode, row)) for mode, row in enumerate(np.eye(m))]


def _shortened(num: FloatArray, den: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Leave out the powers of ``z^-1`` that neither polynomial has."""
    with np.errstate(all="ignore"):
        shares = [np.abs(values) / (np.max(np.abs(values)) or 1.0) for values in (num, den)]
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
    """The sums of a frame in single precision, product by product, clipped at the limit."""

    def __init__(self, matrix: ArrayLike, limit: float = np.inf) -> None:
        self._rows = np.asarray(matrix, dtype=np.float32)
        self._limit, self._past = np.float32(limit), len(self._rows) // 2  # M
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._memory: _Matrix = np.zeros_like(self._rows)

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (modes,), return the commands that were applied, (modes,)."""
        memory, first = self._memory, self._past + 1
        memory[1:first] = memory[: first - 1].copy()
        memory[0] = y
        u = np.add.accumulate(self._rows * memory, axis=0)[-1]
        u = np.clip(u, -self._limit, self._limit)
        memory[first + 1 :] = memory[first:-1].copy()
        memory[first : first + 1] = u  # nothing to write at M = 0
        return np.asarray(u, dtype=np.float64)


def _round(designs: Sequence[Design], *, order: int, **_: Any) -> list[_Matrix]:
    """Return the columns (2 M + 1, n) of each design, made again where a shaped one fails."""
    integer(order, "order", at_least=1)
    numbers = []
    for design in designs:
        exact = direct_form_rows(design.controller, order)
        with np.errstate(over="ignore"):  # what is beyond the range becomes infinite, and refused
            rounded = exact.astype(np.float32)
        if design.mode_specifications:
            checks = prove_written(design, _as_computed(design, rounded))
            if not all(check.passed for check in checks):
                rounded = make_again(design, exact)
        numbers.append(rounded)
    return numbers


def _as_computed(design: Design, rounded: _Matrix) -> Written:
    """Return the controller with the matrix's numbers, and what its arithmetic adds."""
    rows, dt_s = rounded.astype(np.float64), design.controller.dt_s
    order, added = len(rows) // 2, rows.copy()
    added[: order + 1] = np.eye(order + 1, 1)  # an error of the sum enters as b_0 y(k) does
    controller, entry = (direct_form(matrix, dt_s) for matrix in (rows, added))
    loops: list[DirectFormLoop] = mode_loops(design, order)
    sensors = np.diag(require_hardware(design, "dao").sensor)

    def variance(sensor_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
        """Add up the rounding of each product and of each partial sum."""
        if loops:
            sums = [loop.sums_nm2(c, sensor_gain) for loop, c in zip(loops, rows.T, strict=True)]
            return np.array(sums) * sensors**2
        sizes = np.where(np.arange(len(rows))[:, None] <= order, measured, commands)
        # a bound: signs and correlations are not used
        bound = sums_variance((rows * sizes).T, 0, ROUNDOFF["single"])
        return bound(sensor_gain, np.ones(len(rows)), np.zeros(0))

    return Written(controllers={frozenset(): controller}, entry=entry, variance=variance)


def _join(numbers: Sequence[_Matrix], parts: Sequence[ModeDesign], count: int) -> _Matrix:
    """Return the matrix of all modes; further columns are zero."""
    matrix = np.zeros((len(numbers[0]), count), dtype=np.float32)
    for columns, part in zip(numbers, parts, strict=True):
        matrix[:, list(part.modes)] = columns
    return matrix


def _write(
    place: Path, matrix: _Matrix, design: Design, origin: Sequence[str], **_: Any
) -> dict[Path, bytes]:
    """Return the matrix as FITS or as a file of numpy, by the ending."""
    if place.suffix.lower() == ".fits":
        cards: dict[str, Any] = {
            "METHOD": (design.method, "synthesis"),
            "ORDER": (len(matrix) // 2, "M: rows b_0..b_M, then a_1..a_M"),
        }
        comments = [*origin, _SIGN]
        return {place: fits_bytes(cards, {"K_MAT": matrix}, comments=comments)}
    buffer = io.BytesIO()
    np.save(buffer, matrix, allow_pickle=False)
    return {place: buffer.getvalue()}


def _read(files: Mapping[Path, bytes], _: _Matrix) -> _Matrix:
    """Return the matrix that a file holds."""
    ((place, content),) = files.items()
    if place.suffix.lower() == ".fits":
        with open_fits(content) as units:
            return np.array(units["K_MAT"].data, dtype=np.float32)
    return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))


def _remark(design: Design, columns: _Matrix) -> str:
    """Return that coefficients are not those of the gain file."""
    exact = direct_form_rows(design.controller, len(columns) // 2)
    if np.array_equal(columns, exact.astype(np.float32)):
        return ""
    return "made again for single precision; the loop keeps what the gain file promises"


TARGET = Target(
    arithmetic=Arithmetic(
        program="Durham's dao real-time computers",
        precision="single",
        sums="per mode, product by product: b_0 y(k) .. b_M y(k-M), a_1 u(k-1) .. a_M u(k-M)",
        state="past measurements and past applied commands",
        clipping="at the voltage limit; the memory then holds the applied commands",
        limits="one transfer function per mode, of order M at most",
    ),
    file="matrix of single precision (.npy, .fits) and its certificate (.json)",
    options={"order": 20, "modes": None, "other_gain": None},
    round=_round,
    write=_write,
    read=_read,
    computed=_as_computed,
    start=InnerLoop,
    join=_join,
    facts=lambda _, **options: {"sign": _SIGN},
    remark=_remark,
    hint="Give an even order, design with fewer states or less accurate models, or use a target in "
    "double precision.",
    endings=(".npy", ".fits"),
)
