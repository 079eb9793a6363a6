"""Transfer functions of a controller, computed exactly and rounded once."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np

from lbt_synth.errors import NumericalError, ProblemError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.validation import BoolArray, FloatArray

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
