"""Structured doubling for ``X = A' X (I + G X)^-1 A + H``, many equations at once.

E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77, 767 (2004),
doi:10.1080/00207170410001714988. After j steps the iterate holds 2^j steps of
the Riccati recursion; the convergence is quadratic. G need not be semidefinite.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.batched import frobenius_norms, solve_stack, symmetrise, transpose
from lbt_synth.validation import BoolArray, FloatArray, IntArray

MAX_DOUBLINGS = 60
_ROUNDING = 4 * np.finfo(float).eps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DoublingResult:
    """The last iterates of a stack of N equations."""

    X: FloatArray  # (N, n, n): not finite where the recursion diverged
    steps: IntArray  # (N,): doublings
    converged: BoolArray  # (N,): whether the last step changed X by no more than rounding


def doubling(
    A: FloatArray, G: FloatArray, H: FloatArray, *, max_steps: int = MAX_DOUBLINGS
) -> DoublingResult:
    """Iterate to the stabilising X of ``X = A' X (I + G X)^-1 A + H``; all are (N, n, n).

    An equation leaves the stack as soon as it has converged or diverged.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.riccati.doubling import doubling
    >>> one = np.ones((1, 1, 1))
    >>> done = doubling(one, one, one)
    >>> round(float(done.X[0, 0, 0]), 12), bool(done.converged[0])  # the golden ratio
    (1.61803398875, True)
    """
    count, n = A.shape[0], A.shape[-1]
    identity = np.eye(n)
    X_out = np.array(H)
    steps = np.zeros(count, dtype=np.int64)
    converged = np.zeros(count, dtype=bool)
    going = np.arange(count)
    X = X_out
    with np.errstate(all="ignore"):
        for step in range(1, max_steps + 1):
            solved = solve_stack(identity + G @ X, np.concatenate([A, G], axis=-1))
            WA, WG = solved[..., :n], solved[..., n:]
            increment = symmetrise(transpose(A) @ X @ WA)
            G = symmetrise(G + A @ WG @ transpose(A))
            X = X + increment
            A = A @ WA
            size = frobenius_norms(X)
            still = frobenius_norms(increment) <= _ROUNDING * size
            left = still | ~np.isfinite(size)
            if left.any() or step == max_steps:
                steps[going], X_out[going] = step, X
                converged[going] = still & np.isfinite(size)
                keep = ~left
                going = going[keep]
                if going.size == 0:
                    break
                A, G, X = A[keep], G[keep], X[keep]
    return DoublingResult(X=X_out, steps=steps, converged=converged)
