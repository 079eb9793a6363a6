"""The free parameter of least variance whose loop stays below a level, frequency by frequency."""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from lbt_synth.linear.lmi.conic_data import require_optimum
from lbt_synth.linear.lmi.solver import solve, symmetrise
from lbt_synth.linear.output_feedback.free_parameter import FreeParameter
from lbt_synth.validation import FloatArray


def least_variance_below(
    loop: FreeParameter, gamma: float, taps: int, frequency_hz: FloatArray
) -> FloatArray:
    """Return the taps (T, m2, p2) of the least ``|Q|`` with the loop below gamma at frequencies.

    T12 is inner and T21 co-inner: with their orthogonal complements the loop is
    ``[[E11 + Q, E12], [E21, E22]]``, of which Q moves the first block alone.
    """
    m2, p2 = loop.T12.B.shape[1], len(loop.T21.C)
    Q = cp.Variable((m2, p2 * taps))
    z = np.exp(2j * np.pi * frequency_hz * loop.T11.dt_s)
    parts = (s.frequency_response(frequency_hz) for s in (loop.T11, loop.T12, loop.T21))
    constraints = []
    for point, T11, T12, T21 in zip(z, *parts, strict=True):
        left, right = _completed(T12), _completed(T21.conj().T)
        fixed = left.conj().T @ T11 @ right / gamma
        powers = np.kron((point ** -np.arange(taps))[:, None], np.eye(p2))  # (T p2, p2)
        place = np.eye(len(fixed), m2)
        wide = np.eye(p2, fixed.shape[1])
        real = fixed.real + place @ (Q @ powers.real) @ wide / gamma
        imaginary = fixed.imag + place @ (Q @ powers.imag) @ wide / gamma
        block = cp.bmat([[real, -imaginary], [imaginary, real]])
        rows, columns = (2 * size for size in fixed.shape)
        whole = cp.bmat([[np.eye(rows), block], [block.T, np.eye(columns)]])
        constraints.append(symmetrise(whole) >> 0)
    run = solve(cp.Minimize(cp.norm(Q, "fro")), constraints)
    require_optimum(
        run, "the programme of the mixed controller", "Try a larger gamma, or more taps."
    )
    return np.moveaxis(np.asarray(Q.value).reshape(m2, taps, p2), 1, 0)


def _completed(columns: FloatArray) -> FloatArray:
    """Return a unitary matrix that begins with orthonormal columns."""
    full = np.linalg.qr(columns, mode="complete")[0]
    full[:, : columns.shape[1]] = columns
    return np.asarray(full)
