"""Export a controller as transfer functions, in the file that SPECULA's IirFilter loads."""

from __future__ import annotations

import io
import os
from fractions import Fraction
from typing import Any

import numpy as np

from lbt_synth.design import Check, Design, certify_loop
from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.interop.export_certificate import write_export
from lbt_synth.interop.export_checks import (
    Exported,
    join_labels,
    provenance_lines,
    rehearsal_error,
    require_exportable,
)
from lbt_synth.interop.iir.realisation import build_controller
from lbt_synth.interop.target import Arithmetic, Target
from lbt_synth.interop.written_loop import ROUNDOFF, Rounding, prove_written, require_proved
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.storage.array_file import fits_bytes
from lbt_synth.storage.atomic_files import require_ending
from lbt_synth.validation import BoolArray, FloatArray, choice, frozen_copy, number

_LAYOUT_VERSION = 1  # of SPECULA's IirFilterData
_SWITCH = {"double": 0, "single": 1}  # SPECULA's own ``precision``
_KINDS: dict[str, Any] = {"double": np.float64, "single": np.float32}
_HINT = "Use the gain file itself, which SPECULA's SsrFilter loads, or a design of fewer states."


class DirectForm:
    """Transfer functions stepped as SPECULA's IirFilter does: past inputs and past outputs.

    Coefficients (m, k) ascend in z and are right-aligned; ``dtype`` is the precision throughout.
    """

    def __init__(self, num: FloatArray, den: FloatArray, dtype: Any = np.float64) -> None:
        self._num, self._den, self._dtype = num.astype(dtype), den.astype(dtype), dtype
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._inputs = np.zeros(self._num.shape, dtype=self._dtype)
        self._outputs = np.zeros(self._den.shape, dtype=self._dtype)

    def step(self, y: FloatArray) -> FloatArray:
        """Take y(k), return u(k)."""
        self._inputs[:, :-1] = self._inputs[:, 1:]
        self._outputs[:, :-1] = self._outputs[:, 1:]
        self._inputs[:, -1] = y
        past = np.sum(self._den[:, :-1] * self._outputs[:, :-1], axis=1)
        u = (np.sum(self._num * self._inputs, axis=1) - past) / self._den[:, -1]
        self._outputs[:, -1] = u
        return np.asarray(u, dtype=np.float64)


def export_iir(
    path: str | os.PathLike[str],
    design: Design,
    *,
    precision: str = "double",
    tolerance: float = 1e-6,
    gain_digest: str | None = None,
) -> Exported:
    """Write a controller as a file of SPECULA's ``IirFilterData``, one transfer function per axis.

    The coefficients are computed exactly and rounded once. Even so a transfer function loses
    digits with its order, above all in single precision: before anything is written, it is run
    beside the controller in the closed loop, in both precisions.

    Parameters
    ----------
    path : path-like
        File to write, ending in ``.fits``.
    design : Design
        Design with as many commands as measurements, whose axes decouple.
    precision : {"double", "single"}, optional
        In which SPECULA shall run it: what the loop is proved in. The file is the same but for
        a card that states it.
    tolerance : float, optional
        Largest error in double precision that is accepted: difference of the commands over the
        largest command, over 2000 frames.
    gain_digest : str, optional
        SHA-256 of the gain file, for the header (64 hexadecimal digits).

    Returns
    -------
    Exported
        The file, its certificate, its error in double and in single precision, and the checks.

    Raises
    ------
    OutputError
        If the ending is not ``.fits``, or the file cannot be written.
    ProblemError
        If sizes differ or axes are coupled.
    NumericalError
        If the error in double precision is above the tolerance, or a check fails in the
        precision; ``residual`` holds the value.
    CertificateError
        If the certificate that the design carries has a failed check.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     lbt.interop.export_iir(pathlib.Path(folder) / "slow.fits", slow).error < 1e-12
    True
    """
    target = require_ending(path, "an IIR filter file", (".fits",))
    tolerance = number(tolerance, "tolerance", above=0)
    choice(precision, "precision", tuple(_SWITCH))
    require_exportable(design)
    lines = provenance_lines(design, gain_digest)
    num, den = _align(axis_polynomials(design.controller))
    error, single = (_rehearse(design, num, den, dtype) for dtype in (np.float64, np.float32))
    if not error <= tolerance:
        raise NumericalError(
            f"the transfer function must give the commands of the controller to {tolerance:.3g} of "
            f"the largest one; got {error:.3g}: its coefficients in double precision do not hold "
            f"the poles. {_HINT}",
            status="transfer function",
            residual=error,
        )
    count = np.full(len(num), num.shape[1], dtype=np.int64)
    cards: dict[str, Any] = {
        "VERSION": (_LAYOUT_VERSION, "layout of the HDUs"),
        "METHOD": (design.method, "synthesis"),
        "ERROR64": (error, "commands in double precision, relative"),
        "PRECISN": (_SWITCH[precision], "of SPECULA, for which the loop was proved"),
        "FORM": ("plain", "assumes that its commands are applied"),
    }
    arrays = {"ORDNUM": count, "ORDDEN": count, "NUM": num, "DEN": den}
    data = fits_bytes(cards, arrays, comments=join_labels(lines))
    checks = _prove(design, data, precision)
    require_proved(checks, f"{precision} precision, as a transfer function", _HINT)
    return write_export(
        {target: data},
        target="iir",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        precision=precision,
        specula_precision=_SWITCH[precision],
        error=error,
        error_single=single,
        start=lambda _: DirectForm(num, den, _KINDS[precision]),
    )


def _prove(design: Design, data: bytes, precision: str) -> tuple[Check, ...]:
    """Check the loop around the transfer functions that a file holds, rounded to a precision."""
    if design.hardware is None:
        return ()
    from astropy.io import fits

    with fits.open(io.BytesIO(data)) as units, np.errstate(over="ignore"):
        rounded = (np.asarray(units[n].data, _KINDS[precision]) for n in ("NUM", "DEN"))
        num, den = (part.astype(float) for part in rounded)
    sums = np.zeros_like(num)
    sums[:, -1] = 1.0
    written, entry = (build_controller(top, den, design.controller.dt_s) for top in (num, sums))

    def variance(_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
        """Bound the rounding of sums in any order, of their difference and of the quotient."""
        terms = np.stack([np.abs(num) * measured[:, None], np.abs(den) * commands[:, None]])
        whole = np.sum(terms, axis=2)
        count = num.shape[1]
        squares = np.sum(terms**2, axis=2) + count * whole**2
        return np.asarray(
            ROUNDOFF[precision] ** 2 / 3 * (np.sum(squares, axis=0) + 2 * commands**2)
        )

    return prove_written(design, written, Rounding(entry=entry, variance=variance))


def _align(pairs: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Stack polynomials of any length with the highest powers in the last column."""
    length = max(len(den) for _, den in pairs)
    num, den = (
        np.array([np.pad(pair[i], (length - len(pair[i]), 0)) for pair in pairs]) for i in (0, 1)
    )
    return num, den


def _rehearse(design: Design, num: FloatArray, den: FloatArray, dtype: Any) -> float:
    """Return the rehearsal's error; inf where the loop is unstable, however slowly it grows."""
    if design.hardware is not None:
        top, bottom = (frozen_copy(part.astype(dtype)) for part in (num, den))
        written = build_controller(top, bottom, design.controller.dt_s)
        if not certify_loop(design.hardware, written).passed:
            return float("inf")
    return rehearsal_error(design, DirectForm(num, den, dtype))


_COUPLED = 1e-9  # of the largest balanced entry; less is what a solver leaves of a zero
_NEGLIGIBLE = 1e-40  # of the largest entry; no digit of any coefficient depends on less
_MOST_STATES = 40


def axis_polynomials(controller: Controller) -> list[tuple[FloatArray, FloatArray]]:
    """Return numerator and denominator (k,) of each axis, coefficients ascending in z.

    States that an axis does not drive, or does not show in its command, are left out; common
    factors of z are divided out. Denominators are monic; both have the same length.
    """
    m, q = len(controller.C), controller.B.shape[1]
    if m != q:
        raise ProblemError(
            f"a filter per axis needs as many commands as measurements; got {m} commands and {q} "
            "measurements. Use the gain file itself."
        )
    balanced = StateSpace.of([getattr(controller, name) for name in "ABCD"]).balanced()
    links = {name: _find_links(getattr(balanced, name)) for name in "ABC"}
    reached, shown = _reach(links["A"], links["B"]), _reach(links["A"].T, links["C"].T)
    direct = np.abs(controller.D) > _COUPLED * max(
        np.max(np.abs(controller.D)), np.max(np.abs(controller.C @ controller.B))
    )
    coupled = np.argwhere((direct | (shown.T @ reached)) & ~np.eye(q, dtype=bool))
    if coupled.size:
        raise ProblemError(
            "the axes must decouple: one transfer function each; here measurement "
            f"{coupled[0, 1] + 1} moves command {coupled[0, 0] + 1}. Use the gain file itself, "
            "which SPECULA's SsrFilter loads."
        )
    pairs = []
    for i in range(q):
        own = np.flatnonzero(reached[:, i] & shown[:, i])
        if own.size > _MOST_STATES:
            raise ProblemError(
                f"an axis must have at most {_MOST_STATES} states for a transfer function; got "
                f"{own.size}. Use the gain file itself, or design with fewer states."
            )
        pairs.append(
            _exact_quotient(
                _drop_negligible(balanced.A[np.ix_(own, own)]),
                _drop_negligible(balanced.B[own, i]),
                _drop_negligible(balanced.C[i, own]),
                float(controller.D[i, i]),
            )
        )
    return pairs


def _find_links(matrix: FloatArray) -> BoolArray:
    """Return which entries couple, (rows, columns)."""
    return np.asarray(np.abs(matrix) > _COUPLED * np.max(np.abs(matrix), initial=0.0))


def _drop_negligible(matrix: FloatArray) -> FloatArray:
    """Set entries to zero that are so small that they only cost digits."""
    size = np.max(np.abs(matrix), initial=0.0)
    return np.where(np.abs(matrix) > _NEGLIGIBLE * size, matrix, 0.0)


def _reach(steps: BoolArray, start: BoolArray) -> BoolArray:
    """Return the states reached from each start (n, k), where ``steps[i, j]`` leads from j to i."""
    found = start.copy()
    while True:
        more = found | (steps @ found)
        if np.array_equal(more, found):
            return found
        found = more


def _exact_quotient(A: FloatArray, b: FloatArray, c: FloatArray, d: float) -> Any:
    """Return ``z c (zI - A)^-1 b + d`` as a quotient, by the Faddeev-LeVerrier recursion.

    The entries are dyadic fractions, so a common power of two makes them integers; the
    divisions of the recursion then leave no remainder, and only the result is rounded.
    """
    n = len(A)
    (N, s), (B, sb), (C, sc) = (_scale_to_integers(part) for part in (A, b, c))
    den = [Fraction(0)] * n + [Fraction(1)]
    num = [Fraction(0)] * (n + 1)
    M = np.eye(n, dtype=object)  # adj(zI - N) = M_1 z^(n-1) + M_2 z^(n-2) + ...
    for k in range(1, n + 1):
        num[n - k + 1] = Fraction(int(C @ M @ B), 1 << (s * (k - 1) + sb + sc))
        M = N @ M
        trace = -int(np.trace(M)) // k
        den[n - k] = Fraction(trace, 1 << (s * k))
        M = M + trace * np.eye(n, dtype=object)
    exact = Fraction(d)
    num = [v + exact * w for v, w in zip(num, den, strict=True)]
    while len(den) > 1 and num[0] == 0 and den[0] == 0:
        num, den = num[1:], den[1:]
    try:
        return np.array([float(v) for v in num]), np.array([float(v) for v in den])
    except OverflowError as error:
        raise NumericalError(
            "a coefficient of the transfer function is too large for double precision. "
            "Use the gain file itself."
        ) from error


def _scale_to_integers(values: FloatArray) -> tuple[Any, int]:
    """Return integers and the power of two by which to divide them."""
    ratios = [float(v).as_integer_ratio() for v in values.ravel()]
    power = max((bottom.bit_length() - 1 for _, bottom in ratios), default=0)
    whole = np.array([top * ((1 << power) // bottom) for top, bottom in ratios], dtype=object)
    return whole.reshape(values.shape), power


TARGET = Target(
    arithmetic=Arithmetic(
        program="SPECULA's IirFilter",
        precision="single by default; double with precision 0",
        sums="sum of the past inputs less the sum of the past outputs, per axis",
        state="past measurements and past commands",
        clipping="none: plain form, it assumes that its commands are applied",
        limits="one transfer function per axis, of 40 states at most",
    ),
    file="filter file (.fits)",
    write=export_iir,
    endings=(".fits",),
)
