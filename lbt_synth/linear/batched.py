"""Linear algebra on stacks of matrices, arrays (N, n, m)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lbt_synth.validation import Entry, FloatArray


def transpose(stack: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Transpose each matrix of a stack."""
    return stack.swapaxes(-1, -2)


def symmetrise(stack: FloatArray) -> FloatArray:
    """Symmetric part of each matrix of a stack."""
    return np.asarray((stack + transpose(stack)) / 2, dtype=np.float64)


def frobenius_norms(stack: npt.NDArray[Entry]) -> FloatArray:
    """Frobenius norm of each matrix of a stack, (N,)."""
    squares = np.einsum("...ij,...ij->...", stack, stack.conj())  # type: ignore[arg-type]
    return np.asarray(np.sqrt(squares.real), dtype=np.float64)


def solve_stack(matrices: npt.NDArray[Entry], right: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Solve each system of a stack, (N, n, n) and (N, n, m); a singular one gives nan.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.batched import solve_stack
    >>> solve_stack(np.array([[[2.0]], [[0.0]]]), np.ones((2, 1, 1))).ravel().tolist()
    [0.5, nan]
    """
    try:
        return np.asarray(np.linalg.solve(matrices, right))  # type: ignore[arg-type]
    except np.linalg.LinAlgError:
        out = np.full_like(right, np.nan)
        for i in range(len(matrices)):
            try:
                out[i] = np.linalg.solve(matrices[i], right[i])
            except np.linalg.LinAlgError:
                continue
        return out
