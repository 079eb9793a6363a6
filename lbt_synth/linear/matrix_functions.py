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


def nearest_powers_of_two(sizes: FloatArray) -> FloatArray:
    """Return the powers of two nearest to sizes, by which nothing is rounded; 1 for none.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.matrix_functions import nearest_powers_of_two
    >>> nearest_powers_of_two(np.array([0.9, 3.0, 0.0])).tolist()
    [1.0, 4.0, 1.0]
    """
    return np.asarray(np.exp2(np.round(np.log2(np.where(sizes > 0, sizes, 1.0)))))


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
