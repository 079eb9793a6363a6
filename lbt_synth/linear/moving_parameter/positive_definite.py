"""Prove that matrices are positive definite, whatever rounding has done.

Cholesky's factorisation in floating-point numbers that runs to its end proves that the matrix
plus a known one, of norm at most ``(n + 1) u / (1 - (n + 1) u)`` times the trace, is positive
semidefinite (N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., theorem 10.3;
S. M. Rump, BIT 46, 433 (2006), doi:10.1007/s10543-006-0056-1). What the entries may be wrong by is
subtracted from the diagonal first.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.batched import symmetrise
from lbt_synth.validation import BoolArray, FloatArray

UNIT = 2.0**-53  # largest relative error of one rounding
_INFLATION = 1.01  # covers the rounding of the bounds themselves
_SMALLEST = 1e-290  # covers underflow


def certainly_positive(stack: FloatArray, errors: FloatArray) -> BoolArray:
    """Say which matrices (N, n, n) are positive definite within errors (N,) of their norms.

    True is a proof for every symmetric matrix whose distance from the given one is at most the
    error, in the spectral norm; False says nothing.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.moving_parameter.positive_definite import certainly_positive
    >>> almost = np.array([[[1.0, 1.0 - 1e-9], [1.0 - 1e-9, 1.0]]] * 2)
    >>> certainly_positive(almost, np.array([0.0, 2e-9])).tolist()
    [True, False]
    """
    size = stack.shape[-1]
    rest = symmetrise(stack)
    diagonal = np.einsum("...ii->...i", rest)
    rounding = 2 * (size + 3) * UNIT * np.sum(np.abs(diagonal), axis=-1)
    rest = rest - (_INFLATION * (errors + rounding) + _SMALLEST)[:, None, None] * np.eye(size)
    proved = np.ones(len(rest), dtype=np.bool_)
    with np.errstate(all="ignore"):
        for j in range(size):
            pivot = rest[:, j, j]
            proved &= pivot > 0  # not so nan
            column = rest[:, j + 1 :, j] / np.sqrt(np.where(proved, pivot, 1.0))[:, None]
            rest[:, j + 1 :, j + 1 :] -= column[:, :, None] * column[:, None, :]
    return proved
