"""Structured doubling for ``X = A' X (I + G X)^-1 A + H``.

E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77, 767 (2004),
doi:10.1080/00207170410001714988. After j steps the iterate holds 2^j steps of
the Riccati recursion; the convergence is quadratic. G need not be semidefinite.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import FloatArray

MAX_DOUBLINGS = 60


def doubling(
    A: FloatArray, G: FloatArray, H: FloatArray, *, max_steps: int = MAX_DOUBLINGS
) -> tuple[FloatArray, int, bool]:
    """Iterate to the stabilising X of ``X = A' X (I + G X)^-1 A + H``.

    Parameters
    ----------
    A : (n, n) ndarray
        State matrix.
    G, H : (n, n) ndarray
        Symmetric; H positive semidefinite.
    max_steps : int, optional
        Greatest number of doublings.

    Returns
    -------
    X : (n, n) ndarray
        The last iterate; not finite when the recursion escaped.
    steps : int
        Doublings made.
    converged : bool
        Whether the last step changed X by no more than rounding.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.riccati.doubling import doubling
    >>> one = np.eye(1)
    >>> X, steps, converged = doubling(one, one, one)
    >>> round(float(X[0, 0]), 12), converged          # the golden ratio
    (1.61803398875, True)
    """
    identity = np.eye(A.shape[0])
    X = H
    with np.errstate(all="ignore"):
        for step in range(1, max_steps + 1):
            try:
                solved = np.linalg.solve(identity + G @ X, np.hstack([A, G]))
            except np.linalg.LinAlgError:
                return np.full_like(H, np.nan), step, False
            WA, WG = np.hsplit(solved, 2)
            increment = A.T @ X @ WA
            increment = (increment + increment.T) / 2
            G = G + A @ WG @ A.T
            G = (G + G.T) / 2
            X = X + increment
            A = A @ WA
            size = np.linalg.norm(X, 1)
            if not np.isfinite(size):
                return X, step, False
            if np.linalg.norm(increment, 1) <= 4 * np.finfo(float).eps * size:
                return X, step, True
    return X, max_steps, False
