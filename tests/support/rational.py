"""Exact rational arithmetic on matrices of floating-point numbers, which are rational."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def rational(matrix) -> np.ndarray:
    """Return a matrix of fractions, exactly."""
    return np.vectorize(Fraction, otypes=[object])(np.asarray(matrix))


def is_positive_definite(matrix) -> bool:
    """Eliminate without rounding: every pivot of a positive definite matrix is positive."""
    rest = rational(matrix)
    for j in range(len(rest)):
        if rest[j, j] <= 0:
            return False
        column = rest[j + 1 :, j] / rest[j, j]
        rest[j + 1 :, j + 1 :] = rest[j + 1 :, j + 1 :] - np.outer(column, rest[j, j + 1 :])
    return True
