"""Export a controller as the matrix that Durham's dao real-time computers load."""

from __future__ import annotations

import io
import os
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lbt_synth.design import Check, Design, ShapedDesign
from lbt_synth.design.result import require_hardware
from lbt_synth.interop.dao.direct_form import InnerLoop, direct_form, direct_form_rows
from lbt_synth.interop.dao.refit import (
    DirectFormLoop,
    refit,
    round_together,
    shaped_mode_loop,
)
from lbt_synth.interop.export_checks import (
    Exported,
    join_labels,
    provenance_lines,
    rehearsal_error,
    write_export,
)
from lbt_synth.interop.modes import ModalDesign, all_modes
from lbt_synth.interop.target import Arithmetic, Target
from lbt_synth.interop.written_loop import ROUNDOFF, Rounding, prove_written, require_proved
from lbt_synth.linear import Controller
from lbt_synth.models import LoopHardware
from lbt_synth.storage.array_file import fits_bytes
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.validation import FloatArray, integer

_HINT = "Design with fewer states or less accurate models, or use a target in double precision."
_OWN = "of the gain file, rounded"
_AGAIN = "made again for single precision; the loop keeps what the gain file promises"
_SIGN = "actuators = -M2V u; y and u in the units of the mode, with the mirror's sign"


def export_dao(
    path: str | os.PathLike[str],
    design: ModalDesign,
    *,
    order: int = 20,
    modes: int | None = None,
    other_gain: float | None = None,
    hardware: LoopHardware | None = None,
    gain_digest: str | None = None,
) -> Exported:
    """Write a controller as the matrix of a dao real-time computer, one column per mode.

    The RTC computes ``u(k) = b_0 y(k) + .. + b_M y(k-M) + a_1 u(k-1) + .. + a_M u(k-M)`` per mode
    in single precision. Rows ``0 .. M`` of the matrix are ``b``, rows ``M+1 .. 2M`` are ``a``.
    The loop is closed around the rounded coefficients before anything is written, at the sensor
    gains of the design, and the rounding of the sums counts as noise. A shaped design whose own
    coefficients fail is made again, with all the coefficients that the order has.

    Parameters
    ----------
    path : path-like
        File to write, ending in ``.npy`` or ``.fits``. The proof goes beside it, with
        ``.certificate.json`` after its name.
    design : Design, MixedController or ModalFilters
        Design whose modes decouple, with unit sensor and influence matrices; or a design with
        integrators for the other modes; or a filter for each mode.
    order : int, optional
        M of the RTC's configuration; its own default is 20.
    modes : int, optional
        Columns of the matrix; by default those of the design. Further columns are zero, and their
        modes get no command, without ``other_gain``.
    other_gain : float, optional
        Gain of an integrator for each further mode.
    hardware : LoopHardware, optional
        Loop of the integrators, where no filter says which.
    gain_digest : str, optional
        SHA-256 of the gain file, for the certificate (64 hexadecimal digits).

    Returns
    -------
    Exported
        Matrix and certificate, the error in double and in single precision, and the checks.

    Raises
    ------
    OutputError
        If the ending is neither, or a file cannot be written.
    ProblemError
        If the design is not of such a loop, its modes are coupled, or the order is too low.
    CertificateError
        If the certificate that the design carries has a failed check.
    NumericalError
        If a check fails in the arithmetic of the RTC; ``residual`` holds its value.

    Examples
    --------
    >>> import lbt_synth as lbt, numpy as np, tempfile, pathlib
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder) / "slow.npy"
    ...     _ = lbt.interop.export_dao(file, slow, order=1, modes=3)
    ...     np.load(file).tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    """
    target = require_ending(path, "a matrix of dao", (".npy", ".fits"))
    whole = all_modes(design, "a dao matrix", modes=modes, other_gain=other_gain, hardware=hardware)
    order = integer(order, "order", at_least=1)
    matrix = np.zeros((2 * order + 1, whole.count), dtype=np.float32)
    checks: list[Check] = []
    again, error = False, 0.0
    for part in whole.parts:
        proved = _proved_columns(part.design, order)
        matrix[:, part.modes] = proved.columns
        again |= proved.made_again
        error = max(error, rehearsal_error(part.design, InnerLoop(proved.columns)))
        checks += whole.name_checks(part, proved.checks)
    first = whole.parts[0].design
    lines = provenance_lines(first, gain_digest)
    content = _matrix_bytes(matrix, first, lines, fits=target.suffix.lower() == ".fits")
    written = write_export(
        {target: content},
        target="dao",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        order=order,
        modes=whole.count,
        sign=_SIGN,
        coefficients=_AGAIN if again else _OWN,
        error=error,
        start=lambda limit: InnerLoop(matrix[:, : whole.own], limit=limit),
    )
    return replace(written, made_again=again)


class _Proved(NamedTuple):
    """Columns (2 M + 1, n) of a design, and what was checked of them."""

    columns: NDArray[np.float32]
    checks: tuple[Check, ...]
    made_again: bool


def _proved_columns(design: Design, order: int) -> _Proved:
    """Return the columns of a design, proved in the arithmetic of the RTC."""
    exact = direct_form_rows(design.controller, order)
    with np.errstate(over="ignore"):  # what is beyond the range becomes infinite, and is refused
        rounded = exact.astype(np.float32)
    loops = _mode_loops(design, order)
    checks = prove_written(design, *_as_computed(rounded, design, loops))
    made_again = False
    if isinstance(design, ShapedDesign) and not all(check.passed for check in checks):
        made_again = _can_make_again(exact)
        if made_again:
            rounded = _made_again(design, exact)
            checks = prove_written(design, *_as_computed(rounded, design, loops))
    require_proved(checks, "single precision, in direct form", _HINT)
    return _Proved(rounded, checks, made_again)


def _as_computed(
    rounded: NDArray[np.float32], design: Design, loops: list[DirectFormLoop]
) -> tuple[Controller, Rounding]:
    """Return the controller with the matrix's numbers, and what its arithmetic adds."""
    rows, dt_s = rounded.astype(np.float64), design.controller.dt_s
    order, added = len(rows) // 2, rows.copy()
    added[: order + 1] = np.eye(order + 1, 1)  # an error of the sum enters as b_0 y(k) does
    written, entry = (direct_form(matrix, dt_s) for matrix in (rows, added))

    def variance(sensor_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
        """Add up the rounding of each product and of each partial sum."""
        if loops:
            columns = zip(loops, rows.T, strict=True)
            return np.array([loop.sums_nm2(column, sensor_gain) for loop, column in columns])
        sizes = np.where(np.arange(len(rows))[:, None] <= order, measured, commands)
        terms = np.abs(rows) * sizes  # a bound: their signs and correlations are not used
        squares = terms**2 + np.cumsum(terms, axis=0) ** 2
        return np.asarray(ROUNDOFF["single"] ** 2 / 3 * np.sum(squares, axis=0))

    return written, Rounding(entry=entry, variance=variance)


def _mode_loops(design: Design, order: int) -> list[DirectFormLoop]:
    """Return the loop of each mode of a shaped design, made once for equal ones; none of others."""
    if not isinstance(design, ShapedDesign):
        return []
    hardware = require_hardware(design, "dao")
    found = {
        mode: shaped_mode_loop(hardware, design.specifications[mode], order)
        for mode in set(design.first_equal_modes)
    }
    return [found[mode] for mode in design.first_equal_modes]


def _can_make_again(exact: FloatArray) -> bool:
    """Whether the controller of each mode is a starting point: of an even order, not late."""
    odd = (len(exact) // 2) % 2
    unused = exact[[len(exact) // 2, -1]]
    return bool(exact[0].all()) and not (odd and unused.any())


def _made_again(design: ShapedDesign, exact: FloatArray) -> NDArray[np.float32]:
    """Return the matrix of controllers made for this arithmetic; equal modes are made once."""
    order = len(exact) // 2
    used = np.arange(len(exact))
    if order % 2:  # the search takes coefficients in pairs
        used = np.delete(used, [order, 2 * order])
    loops = _mode_loops(design, order - order % 2)
    modes = design.first_equal_modes
    made = {k: round_together(loops[k], refit(loops[k], exact[used, k])) for k in set(modes)}
    rounded = np.zeros(exact.shape, dtype=np.float32)
    rounded[used] = np.stack([made[k] for k in modes], axis=1)
    return rounded


def _matrix_bytes(
    matrix: NDArray[np.float32], design: Design, lines: list[tuple[str, str]], *, fits: bool
) -> bytes:
    if fits:
        cards: dict[str, Any] = {
            "METHOD": (design.method, "synthesis"),
            "ORDER": (len(matrix) // 2, "M: rows b_0..b_M, then a_1..a_M"),
        }
        return fits_bytes(cards, {"K_MAT": matrix}, comments=[*join_labels(lines), _SIGN])
    buffer = io.BytesIO()
    np.save(buffer, matrix, allow_pickle=False)
    return buffer.getvalue()


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
    write=export_dao,
    endings=(".npy",),
)
