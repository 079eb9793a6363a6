"""The Schur form of a real matrix, also where LAPACK's complex iteration does not end."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, rsf2csf, schur

from lbt_synth.validation import ComplexArray, FloatArray


def complex_schur(A: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return T and U with ``A = U T U*``, T upper triangular and U unitary, (n, n).

    On some companion matrices of long filters the complex iteration fails and the real one ends.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.schur_form import complex_schur
    >>> T, U = complex_schur(np.array([[0.0, -1.0], [1.0, 0.0]]))
    >>> bool(np.allclose(U @ T @ U.conj().T, [[0, -1], [1, 0]]))
    True
    """
    try:
        T, U = schur(A.astype(np.complex128), output="complex")
    except LinAlgError:
        T, U = rsf2csf(*schur(A, output="real"))
    return T, U
