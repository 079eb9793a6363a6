"""Exact rational arithmetic on matrices of floating-point numbers, which are rational."""

from __future__ import annotations

from fractions import Fraction

import numpy as np


def rational(matrix) -> np.ndarray:
    """Return a matrix of fractions, exactly."""
    return np.vectorize(Fraction, otypes=[object])(np.asarray(matrix))


def exact_covariance(A, B):
    """Covariance of ``x+ = A x + B w`` by Gauss-Jordan elimination, (n, n) of fractions."""
    n = len(A)
    A, B = rational(A), rational(B)
    rows = np.hstack([rational(np.eye(n * n)) - np.kron(A, A), (B @ B.T).reshape(-1, 1)])
    for i in range(n * n):
        first = next(j for j in range(i, n * n) if rows[j, i] != 0)
        rows[[i, first]] = rows[[first, i]]
        rows[i] = rows[i] / rows[i, i]
        for j in range(n * n):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, -1].reshape(n, n)
