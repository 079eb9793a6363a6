"""Frequency responses of many systems at the same frequencies, by partial fractions."""

from __future__ import annotations

import numpy as np

from lbt_synth.linear import StateSpace
from lbt_synth.linear.state_space import pointwise_response
from lbt_synth.validation import ComplexArray, FloatArray

_PROBES = 5  # frequencies at which partial fractions are checked by solving linear systems
_AGREEMENT = 1e-9


def batched_response(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, z: ComplexArray
) -> ComplexArray:
    """Transfer matrices (k, f, m, q) of k systems at f points z, by partial fractions.

    A system whose eigenvectors are nearly dependent fails at some probes; its points are then
    solved one by one.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.loop.ensemble.frequency_responses import batched_response
    >>> halves = np.array([[[0.5]], [[-0.5]]])
    >>> one = np.ones((2, 1, 1))
    >>> batched_response(halves, one, one, 0 * one, np.array([1.0 + 0j])).real.ravel().round(6)
    array([2.      , 0.666667])
    """
    out = np.empty((len(A), z.size, C.shape[1], B.shape[2]), dtype=np.complex128)
    if A.shape[1] == 0:
        out[:] = D[:, None]
        return out
    poles, vectors = np.linalg.eig(A)
    with np.errstate(all="ignore"):  # what is not finite fails the probes
        try:
            entries = np.linalg.solve(vectors, B.astype(np.complex128))
        except np.linalg.LinAlgError:  # one of them has no basis of eigenvectors
            entries = np.full(B.shape, np.nan, dtype=np.complex128)
        leaving = C @ vectors
        for i in range(out.shape[2]):
            for j in range(out.shape[3]):
                residues = leaving[:, i] * entries[..., j]
                out[..., i, j] = _partial_fractions(poles, residues, z) + D[:, i, j, None]
    probes = np.linspace(0, z.size - 1, _PROBES).astype(np.int64)
    pencils = z[probes, None, None] * np.eye(A.shape[1]) - A[:, None]
    states = np.linalg.solve(pencils, B[:, None].astype(np.complex128))
    direct = C[:, None] @ states + D[:, None]
    apart = np.max(np.abs(out[:, probes] - direct), axis=(1, 2, 3))
    agree = apart <= _AGREEMENT * np.max(np.abs(direct), axis=(1, 2, 3))
    for k in np.flatnonzero(~agree):
        out[k] = pointwise_response(StateSpace(A=A[k], B=B[k], C=C[k], D=D[k]), z)
    return out


def _partial_fractions(
    poles: ComplexArray, residues: ComplexArray, z: ComplexArray
) -> ComplexArray:
    """Sum ``residue / (z - pole)`` over the poles (k, s), at all points, (k, f).

    In real numbers, which is several times faster than a division of complex ones.
    """
    real, imaginary = np.zeros((2, len(poles), z.size))
    for pole, residue in zip(poles.T[..., None], residues.T[..., None], strict=True):
        x, y = z.real - pole.real, z.imag - pole.imag
        scale = 1 / (x * x + y * y)
        x *= scale
        y *= scale
        real += residue.real * x + residue.imag * y
        imaginary += residue.imag * x - residue.real * y
    return np.asarray(real + 1j * imaginary)
