"""Stationary covariances in rational arithmetic."""

from fractions import Fraction

import numpy as np


def exact_covariance(A, B):
    """Covariance of ``x+ = A x + B w`` by Gauss-Jordan elimination, (n, n) of fractions."""
    n = len(A)
    fractions = np.vectorize(Fraction, otypes=[object])
    A, B = fractions(np.asarray(A, dtype=float)), fractions(np.asarray(B, dtype=float))
    rows = np.hstack([fractions(np.eye(n * n)) - np.kron(A, A), (B @ B.T).reshape(-1, 1)])
    for i in range(n * n):
        first = next(j for j in range(i, n * n) if rows[j, i] != 0)
        rows[[i, first]] = rows[[first, i]]
        rows[i] = rows[i] / rows[i, i]
        for j in range(n * n):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, -1].reshape(n, n)
