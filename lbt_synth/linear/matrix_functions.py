"""Small questions about one matrix that several solvers ask."""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.batched import symmetrise
from lbt_synth.validation import FloatArray


def is_stable(A: FloatArray) -> bool:
    """Return whether all eigenvalues of a matrix (n, n) lie inside the unit circle."""
    return bool(np.max(np.abs(np.linalg.eigvals(A))) < 1)


def relative_distance(own: FloatArray, other: FloatArray) -> float:
    """Return the norm of the difference of two arrays over that of the other."""
    return float(np.linalg.norm(own - other)) / max(float(np.linalg.norm(other)), 1e-300)


def semidefinite_root(M: FloatArray) -> FloatArray:
    """Return R (n, n) with ``R R' = M``, for a semidefinite M but for rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.matrix_functions import semidefinite_root
    >>> abs(semidefinite_root(np.diag([4.0, -1e-17]))).tolist()
    [[0.0, 2.0], [0.0, 0.0]]
    """
    values, vectors = np.linalg.eigh(symmetrise(M))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))
