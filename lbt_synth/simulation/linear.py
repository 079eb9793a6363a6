"""A linear system driven by long series, by matrix products over blocks of frames.

Within a block of b frames the outputs are a matrix times (state at the block's
beginning, inputs of the block); the states at the beginnings obey a recursion
with ``A^b`` that is solved in the same way. The result is that of the
frame-by-frame recursion up to rounding.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.statespace import StateSpace
from lbt_synth.validation import FloatArray, real_array

_BLOCK = 8
_STEPS = 16  # of the recursion between blocks
_CACHED = 500_000  # numbers of inputs and outputs worked on at once


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
    u = np.asarray(inputs, dtype=np.float64)
    m, p = system.B.shape[1], system.C.shape[0]
    if u.ndim < 2 or u.shape[-1] != m:
        raise DimensionError(
            f"inputs must be (..., frames, {m}) to match B {system.B.shape}; got {u.shape}."
        )
    if not np.all(np.isfinite(u)):
        real_array(u, "inputs")  # raises, and says where
    lead, frames = u.shape[:-2], u.shape[-2]
    cases = int(np.prod(lead))
    u = u.reshape(cases, frames, m)
    operators = _block_operators(system)
    out = np.empty((cases, frames, p))
    # as many cases at once as fit into the processor's cache
    batch = max(1, _CACHED // max(1, frames * (m + p)))
    for start in range(0, cases, batch):
        part = slice(start, start + batch)
        out[part] = _filter_batch(operators, u[part])
    return out.reshape(*lead, frames, p)


def _filter_batch(operators: _BlockOperators, u: FloatArray) -> FloatArray:
    cases, frames, m = u.shape
    blocks = -(-frames // _BLOCK)
    if frames != blocks * _BLOCK:
        padded = np.zeros((cases, blocks * _BLOCK, m))
        padded[:, :frames] = u
        u = padded
    chunks = u.reshape(cases, blocks, _BLOCK * m)
    starts = _recursion(operators.step, chunks @ operators.reach)
    out = chunks @ operators.toeplitz
    out += starts @ operators.observe
    return np.asarray(out.reshape(cases, blocks * _BLOCK, -1)[:, :frames])


class _BlockOperators(NamedTuple):
    """What a block of frames does, transposed for row vectors.

    ``step`` advances the state by a block, ``reach`` maps the block's inputs to
    the state after it, ``observe`` the state before it and ``toeplitz`` the
    inputs to the block's outputs.
    """

    step: FloatArray
    reach: FloatArray
    observe: FloatArray
    toeplitz: FloatArray


def _block_operators(system: StateSpace) -> _BlockOperators:
    powers = _powers(system.A, _BLOCK)
    p, m = system.D.shape
    markov = np.stack([system.D] + [system.C @ powers[i] @ system.B for i in range(_BLOCK - 1)])
    # entry (j, input, i, output) is markov[i - j] for i >= j
    lag = np.arange(_BLOCK) - np.arange(_BLOCK)[:, None]
    toeplitz = np.where((lag >= 0)[:, :, None, None], markov[np.maximum(lag, 0)], 0.0)
    return _BlockOperators(
        step=powers[_BLOCK],
        reach=np.vstack([(powers[_BLOCK - 1 - j] @ system.B).T for j in range(_BLOCK)]),
        observe=np.hstack([(system.C @ powers[i]).T for i in range(_BLOCK)]),
        toeplitz=np.ascontiguousarray(
            toeplitz.transpose(0, 3, 1, 2).reshape(_BLOCK * m, _BLOCK * p)
        ),
    )


def _powers(A: FloatArray, highest: int) -> list[FloatArray]:
    powers = [np.eye(A.shape[0])]
    for _ in range(highest):
        powers.append(powers[-1] @ A)
    return powers


def _recursion(A: FloatArray, drive: FloatArray) -> FloatArray:
    """States ``x(j+1) = A x(j) + drive(j)`` from zero, for (cases, steps, n) drives."""
    cases, steps, n = drive.shape
    if steps <= 2 * _STEPS:
        out = np.zeros((cases, steps, n))
        for j in range(steps - 1):
            out[:, j + 1] = out[:, j] @ A.T + drive[:, j]
        return out
    blocks = -(-steps // _STEPS)
    padded = np.zeros((cases, blocks * _STEPS, n))
    padded[:, :steps] = drive
    chunks = padded.reshape(cases, blocks, _STEPS, n)
    powers = _powers(A, _STEPS)
    inside = np.zeros_like(chunks)  # states of each block when it begins at zero
    for j in range(_STEPS - 1):
        inside[:, :, j + 1] = inside[:, :, j] @ A.T + chunks[:, :, j]
    ends = inside[:, :, -1] @ A.T + chunks[:, :, -1]
    starts = _recursion(powers[_STEPS], ends)
    transport = np.hstack([power.T for power in powers[:_STEPS]])  # (n, block n)
    inside += (starts @ transport).reshape(cases, blocks, _STEPS, n)
    return inside.reshape(cases, blocks * _STEPS, n)[:, :steps]
