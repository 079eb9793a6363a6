"""A linear system driven by long series, by matrix products over blocks of frames.

Within a block of b frames the outputs are a matrix times (state at the block's
beginning, inputs of the block); the states at the beginnings obey a recursion
with ``A^b`` that is solved in the same way. The result is that of the
frame-by-frame recursion up to rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.statespace import StateSpace
from lbt_synth.validation import FloatArray, real_array

_BLOCK = 16


def filter_series(system: StateSpace, inputs: Any) -> FloatArray:
    """Compute the outputs of a discrete-time system from a zero state.

    Parameters
    ----------
    system : StateSpace
        The system, with m inputs and p outputs.
    inputs : (..., frames, m) array_like
        Input series; leading dimensions are independent cases.

    Returns
    -------
    (..., frames, p) ndarray
        ``y(k) = C x(k) + D u(k)``.

    Raises
    ------
    ProblemError
        If the inputs are not finite or have another shape.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> total = lbt.StateSpace(A=[[1.0]], B=[[1.0]], C=[[1.0]], D=[[1.0]])
    >>> lbt.filter_series(total, [[1.0], [2.0], [3.0]])[:, 0].tolist()
    [1.0, 3.0, 6.0]
    """
    u = real_array(inputs, "inputs")
    m = system.B.shape[1]
    if u.ndim < 2 or u.shape[-1] != m:
        raise DimensionError(
            f"inputs must be (..., frames, {m}) to match B {system.B.shape}; got {u.shape}."
        )
    lead, frames, p = u.shape[:-2], u.shape[-2], system.C.shape[0]
    cases = int(np.prod(lead))
    blocks = -(-frames // _BLOCK)
    padded = np.zeros((cases, blocks * _BLOCK, m))
    padded[:, :frames] = u.reshape(cases, frames, m)
    chunks = padded.reshape(cases, blocks, _BLOCK * m)

    powers = _powers(system.A, _BLOCK)
    reach = np.hstack([powers[_BLOCK - 1 - j] @ system.B for j in range(_BLOCK)])
    observe = np.vstack([system.C @ powers[i] for i in range(_BLOCK)])
    starts = _recursion(powers[_BLOCK], chunks @ reach.T)
    out = chunks @ _toeplitz(system, powers).T
    out += starts @ observe.T
    return np.asarray(out.reshape(cases, blocks * _BLOCK, p)[:, :frames].reshape(*lead, frames, p))


def _powers(A: FloatArray, highest: int) -> list[FloatArray]:
    powers = [np.eye(A.shape[0])]
    for _ in range(highest):
        powers.append(powers[-1] @ A)
    return powers


def _toeplitz(system: StateSpace, powers: list[FloatArray]) -> FloatArray:
    """Map the inputs of a block to its outputs: D on the diagonal, C A^(i-j-1) B below."""
    p, m = system.D.shape
    markov = [system.D] + [system.C @ powers[i] @ system.B for i in range(_BLOCK - 1)]
    out = np.zeros((_BLOCK * p, _BLOCK * m))
    for i in range(_BLOCK):
        for j in range(i + 1):
            out[i * p : (i + 1) * p, j * m : (j + 1) * m] = markov[i - j]
    return out


def _recursion(A: FloatArray, drive: FloatArray) -> FloatArray:
    """States ``x(j+1) = A x(j) + drive(j)`` from zero, for (cases, steps, n) drives."""
    cases, steps, n = drive.shape
    if steps <= 2 * _BLOCK:
        out = np.zeros((cases, steps, n))
        for j in range(steps - 1):
            out[:, j + 1] = out[:, j] @ A.T + drive[:, j]
        return out
    blocks = -(-steps // _BLOCK)
    padded = np.zeros((cases, blocks * _BLOCK, n))
    padded[:, :steps] = drive
    chunks = padded.reshape(cases, blocks, _BLOCK, n)
    powers = _powers(A, _BLOCK)
    inside = np.zeros_like(chunks)  # states of each block when it begins at zero
    for j in range(_BLOCK - 1):
        inside[:, :, j + 1] = inside[:, :, j] @ A.T + chunks[:, :, j]
    ends = inside[:, :, -1] @ A.T + chunks[:, :, -1]
    starts = _recursion(powers[_BLOCK], ends)
    transport = np.hstack([power.T for power in powers[:_BLOCK]])  # (n, block n)
    inside += (starts @ transport).reshape(cases, blocks, _BLOCK, n)
    return inside.reshape(cases, blocks * _BLOCK, n)[:, :steps]
