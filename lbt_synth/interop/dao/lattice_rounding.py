"""Rounding of many coefficients together, so that their errors cancel where the loop is sensitive.

Each coefficient rounded by itself is off by half a step at most, and the errors add up at random.
Moved by whole steps, often many, they cancel: the search for the steps is the closest vector
problem, solved here as Babai's nearest plane in a reduced basis (L. Babai, Combinatorica 6, 1
(1986), doi:10.1007/BF02579403; A. Lenstra, H. Lenstra, L. Lovasz, Math. Ann. 261, 515 (1982),
doi:10.1007/BF01457454).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lbt_synth.validation import FloatArray

_SHORTER = 0.9  # of Lovasz's condition
_SWAPS = 5  # at most, per pair of columns
_HELD = 1e-13  # of the sensitivity, to an error that does nothing


def round_together(exact: FloatArray, sensitivity: FloatArray) -> NDArray[np.float32]:
    """Round coefficients (n,) to single precision, with a small ``sensitivity @ error``.

    A row of the sensitivity (m, n) says what an error of each does. An exact zero stays zero, and
    where a change does nothing the coefficients stay next to their exact values.

    Examples
    --------
    Two coefficients of which only the sum matters:

    >>> import numpy as np
    >>> from lbt_synth.interop.dao.lattice_rounding import round_together
    >>> exact = np.array([8.0000003, 0.7])
    >>> found = round_together(exact, np.array([[1.0, 1.0], [0.0, 1e-6]]))
    >>> bool(abs(found.astype(float).sum() - exact.sum()) < 3e-8)
    True
    """
    used = np.flatnonzero(exact)
    step = np.spacing(np.abs(exact[used]).astype(np.float32)).astype(np.float64)
    scaled = sensitivity[:, used] * step
    held = _HELD * float(np.linalg.norm(scaled)) * np.eye(used.size)
    scaled = np.linalg.qr(np.vstack([scaled, held]))[1]
    near = np.round(exact[used] / step)
    change = _reduced_change(scaled)
    Q, R = np.linalg.qr(scaled @ change)
    wanted = Q.T @ (scaled @ (exact[used] / step - near))
    moves = np.zeros(used.size)
    for k in range(used.size - 1, -1, -1):
        moves[k] = np.round((wanted[k] - R[k, k + 1 :] @ moves[k + 1 :]) / R[k, k])
    rounded = np.zeros(exact.size, dtype=np.float32)
    rounded[used] = (near + change @ moves) * step
    return rounded


def _reduced_change(triangle: FloatArray) -> FloatArray:
    """Return the whole-numbered change of basis that makes the columns short and nearly square."""
    R, size = triangle.copy(), len(triangle)
    change = np.eye(size)
    k, left = 1, _SWAPS * size**2  # rounding errors may keep a nearly singular basis turning
    while k < size and left:
        for j in range(k - 1, -1, -1):
            times = np.round(R[j, k] / R[j, j])
            R[: j + 1, k] -= times * R[: j + 1, j]
            change[:, k] -= times * change[:, j]
        if np.hypot(R[k, k], R[k - 1, k]) >= np.sqrt(_SHORTER) * abs(R[k - 1, k - 1]):
            k += 1
            continue
        left -= 1
        R[:, [k - 1, k]] = R[:, [k, k - 1]]
        change[:, [k - 1, k]] = change[:, [k, k - 1]]
        a, b = R[k - 1 : k + 1, k - 1] / np.hypot(*R[k - 1 : k + 1, k - 1])
        R[k - 1 : k + 1, k - 1 :] = np.array([[a, b], [-b, a]]) @ R[k - 1 : k + 1, k - 1 :]
        k = max(k - 1, 1)
    return change
