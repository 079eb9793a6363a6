"""Transfer functions as controllers, in coordinates that keep close poles apart.

The coefficients of a polynomial with close roots change by much when the roots change by little,
and so do all results that are computed with them as a companion matrix. The exact quotient of
the coefficients is therefore written in the basis ``1, f_1, f_1 f_2, ..`` (and ``z`` times these)
of factors f of the denominator, which need not be exact: what the coefficients differ from the
product is one more column. Every number is computed exactly and rounded once.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import NumericalError
from lbt_synth.linear import Controller
from lbt_synth.validation import FloatArray, frozen_copy

_Polynomial = list[Fraction]  # coefficients ascending in z


def build_controller(num: FloatArray, den: FloatArray, dt_s: float) -> Controller:
    """Build the controller of coefficients (axes, k), which ascend in z.

    The last state of each axis is its command. A and C depend on the denominators alone.
    Coefficients out of the range of numbers raise a NumericalError.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.interop.iir.realisation import build_controller
    >>> slow = build_controller(np.array([[0.0, 0.5]]), np.array([[-1.0, 1.0]]), 1.0)
    >>> run = slow.start()
    >>> [float(run.step([1.0])[0]) for _ in range(3)]
    [0.5, 1.0, 1.5]
    """
    try:
        axes = [_realise(top, bottom) for top, bottom in zip(num, den, strict=True)]
    except (OverflowError, ValueError) as error:  # a number that is none, or too large a one
        raise NumericalError(
            "the controller's transfer function has coefficients beyond the range of its numbers. "
            "Try a target that keeps the states (c, matlab), or a design with fewer states.",
            status="overflow",
        ) from error
    m, size = len(axes), len(axes[0][0])
    return Controller(
        A=block_diag(*(A for A, _ in axes)),
        B=block_diag(*(B for _, B in axes)),
        C=frozen_copy(np.kron(np.eye(m), np.eye(size)[-1:])),
        D=np.zeros((m, m)),
        dt_s=dt_s,
    )


def _realise(num: FloatArray, den: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return A (k, k) and B (k, 1) of one axis, whose last state is the command."""
    n, last = len(den) - 1, Fraction(float(den[-1]))
    bottom = [Fraction(float(v)) / last for v in den]
    top = [Fraction(float(v)) / last for v in num]
    rest = [a - top[-1] * b for a, b in zip(top, bottom, strict=True)][:-1]
    factors = _factors(den)
    product = [Fraction(1)]
    for factor in factors:
        product = _multiply(product, factor)
    beyond = [a - b for a, b in zip(bottom, product, strict=True)][:-1]
    A, B = np.zeros((n + 1, n + 1)), np.zeros((n + 1, 1))
    A[:, :n] = np.eye(n + 1, n, k=-1)  # z times a basis polynomial is the next one, and
    k = 0
    for factor in factors:  # where a factor is complete, less what the factor has of those before
        k += len(factor) - 1
        A[k + 1 - len(factor) : k, k - 1] = [-float(v) for v in factor[:-1]]
    if n:
        A[:n, n - 1] -= _coordinates(beyond, factors)
    B[:n, 0], B[n, 0] = _coordinates(rest, factors), float(top[-1])
    return A, B


def _factors(den: FloatArray) -> list[_Polynomial]:
    """Return factors of first and second degree whose product is about the polynomial."""
    roots = sorted(np.roots(den[::-1]), key=lambda root: (abs(np.angle(root)), abs(root)))
    numbers = [
        [-root.real, 1.0] if root.imag == 0 else [abs(root) ** 2, -2 * root.real, 1.0]
        for root in roots
        if root.imag >= 0
    ]
    return [[Fraction(float(v)) for v in factor] for factor in numbers]


def _multiply(one: _Polynomial, other: _Polynomial) -> _Polynomial:
    out = [Fraction(0)] * (len(one) + len(other) - 1)
    for i, a in enumerate(one):
        for j, b in enumerate(other):
            out[i + j] += a * b
    return out


def _coordinates(polynomial: _Polynomial, factors: Sequence[_Polynomial]) -> list[float]:
    """Return the coordinates of a polynomial in the basis of the factors, by divisions."""
    out: list[float] = []
    for factor in factors:
        size, rest = len(factor) - 1, list(polynomial)
        for k in range(len(rest) - 1, size - 1, -1):  # what stands above the size is the quotient
            for i in range(size):
                rest[k - size + i] -= rest[k] * factor[i]
        out += [float(v) for v in [*rest[:size], *[Fraction(0)] * size][:size]]
        polynomial = rest[size:]
    return out
