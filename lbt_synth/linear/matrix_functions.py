"""Functions of a matrix, and of stacks of matrices (N, n, m), that numpy and scipy have not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, rsf2csf, schur

from lbt_synth.validation import BoolArray, ComplexArray, Entry, FloatArray, IntArray


def transpose(stack: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Transpose each matrix of a stack."""
    return stack.swapaxes(-1, -2)


def as_stack(matrix: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Return a matrix as a stack of one, and a stack as it is."""
    return matrix[None] if matrix.ndim == 2 else matrix


def symmetrise(stack: FloatArray) -> FloatArray:
    """Symmetric part of each matrix of a stack."""
    return np.asarray((stack + transpose(stack)) / 2, dtype=np.float64)


def frobenius_norms(stack: npt.NDArray[Entry]) -> FloatArray:
    """Frobenius norm of each matrix of a stack, (N,)."""
    squares = np.einsum("...ij,...ij->...", stack, stack.conj())  # type: ignore[arg-type]
    return np.asarray(np.sqrt(squares.real), dtype=np.float64)


def solve_stack(matrices: npt.NDArray[Entry], right: npt.NDArray[Entry]) -> npt.NDArray[Entry]:
    """Solve each system of a stack, (N, n, n) and (N, n, m); a singular one gives nan."""
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


def relative_distance(array: FloatArray, other: FloatArray) -> float:
    """Return the norm of the difference of two arrays over that of the other."""
    return float(np.linalg.norm(array - other)) / max(float(np.linalg.norm(other)), 1e-300)


def nearest_powers_of_two(sizes: FloatArray) -> FloatArray:
    """Return the powers of two nearest to sizes, by which nothing is rounded; 1 for none."""
    return np.asarray(np.exp2(np.round(np.log2(np.where(sizes > 0, sizes, 1.0)))))


def semidefinite_root(M: FloatArray) -> FloatArray:
    """Return R (n, n) with ``R R' = M``, for a semidefinite M but for rounding."""
    values, vectors = np.linalg.eigh(symmetrise(M))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def component_labels(links: BoolArray, *, strong: bool = False) -> IntArray:
    """Return the number of the part of each of n elements (n,), for links (n, n) between them.

    Parts are numbered by their first elements. Those of strong parts reach one another both ways.
    For matrices of control this takes 1 % of the time of scipy's, which makes them sparse first.
    """
    reached = links | np.eye(len(links), dtype=np.bool_)
    if not strong:
        reached |= links.T
    size = 0
    while (now := int(np.count_nonzero(reached))) != size:
        size, steps = now, reached.astype(np.float64)
        reached = steps @ steps > 0
    first = np.argmax(reached & reached.T, axis=1)
    return np.unique(first, return_inverse=True)[1].astype(np.int64)


def part_labels(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the numbers of the parts of a system's states (n,), inputs (m,) and outputs (p,).

    Parts share no state, input or output.
    """
    (n, m), p = B.shape, len(C)
    links = np.zeros((n + m + p, n + m + p), dtype=np.bool_)
    links[:n, : n + m] = np.hstack([A, B]) != 0
    links[n + m :, : n + m] = np.hstack([C, D]) != 0
    label = component_labels(links)
    return label[:n], label[n : n + m], label[n + m :]


def complex_schur(A: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return T and U with ``A = U T U*``, T upper triangular and U unitary, (n, n).

    On some companion matrices of long filters the complex iteration fails and the real one ends.
    """
    try:
        T, U = schur(A.astype(np.complex128), output="complex")
    except LinAlgError:
        T, U = rsf2csf(*schur(A, output="real"))
    return T, U
