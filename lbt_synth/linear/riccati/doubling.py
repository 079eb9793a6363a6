"""Structured doubling for ``X = A' X (I + G X)^-1 A + H``, many equations at once.

E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77, 767 (2004),
doi:10.1080/00207170410001714988. After j steps the iterate holds 2^j steps of
the Riccati recursion; the convergence is quadratic. G need not be semidefinite.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.batched import frobenius_norms, solve_stack, symmetrise, transpose
from lbt_synth.validation import FloatArray, IntArray

_MOST_STEPS = 60
_ROUNDING = 4 * np.finfo(float).eps


def doubling(A: FloatArray, G: FloatArray, H: FloatArray) -> tuple[FloatArray, IntArray]:
    """Iterate to the stabilising X, until a step changes it by no more than rounding.

    All arrays are (N, n, n). Return X, nan where the iteration did not converge, and the steps
    made (N,). An equation leaves the stack as soon as it has converged or diverged.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.riccati.doubling import doubling
    >>> one = np.ones((1, 1, 1))
    >>> round(float(doubling(one, one, one)[0][0, 0, 0]), 12)  # the golden ratio
    1.61803398875
    """
    X, going, n = H, np.arange(len(A)), A.shape[-1]
    found, steps = np.full_like(H, np.nan), np.zeros(len(A), dtype=np.int64)
    with np.errstate(all="ignore"):
        for step in range(1, _MOST_STEPS + 1):
            solved = solve_stack(np.eye(n) + G @ X, np.concatenate([A, G], axis=-1))
            WA, WG = solved[..., :n], solved[..., n:]
            increment = symmetrise(transpose(A) @ X @ WA)
            G = symmetrise(G + A @ WG @ transpose(A))
            X = X + increment
            A = A @ WA
            size = frobenius_norms(X)
            still = frobenius_norms(increment) <= _ROUNDING * size
            keep = ~still & np.isfinite(size)
            steps[going] = step
            if not keep.all():
                converged = still & np.isfinite(size)
                found[going[converged]] = X[converged]
                going, A, G, X = going[keep], A[keep], G[keep], X[keep]
                if going.size == 0:
                    break
    return found, steps
