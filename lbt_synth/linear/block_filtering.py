"""Series of long systems, block by block and without a step for each block.

The system is lifted over the frames of a block. Two steps of the recursion from block to block are
one step with the square of its matrix, so that it is halved until one step is left. The result is
that of the frame-by-frame recursion up to rounding.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError
from lbt_synth.linear import StateSpace
from lbt_synth.validation import FloatArray, real_array

_BLOCK = 8  # frames, fastest for 5 to 50 states (benchmarks/speed.py)
_CACHED = 500_000  # input and output values worked on at once, which fit a processor's cache


def filter_series(system: StateSpace, inputs: ArrayLike) -> FloatArray:
    """Compute the outputs of a discrete-time system from a zero state.

    From inputs (..., frames, m) to ``y(k) = C x(k) + D u(k)``, (..., frames, p); leading dimensions
    are independent cases. Inputs that are not finite or have another shape raise a ProblemError.
    """
    u = real_array(inputs, "inputs")
    (p, m), lead, frames = system.D.shape, u.shape[:-2], u.shape[-2] if u.ndim > 1 else 0
    if u.ndim < 2 or u.shape[-1] != m:
        raise DimensionError(
            f"inputs must be (..., frames, {m}) to match B {system.B.shape}; got {u.shape}."
        )
    block = replace(system, A=np.repeat(system.A[None], _BLOCK, axis=0)).lifted()
    blocks = -(-frames // _BLOCK)  # rounded up
    u = u.reshape(-1, frames, m)
    padded = np.pad(u, ((0, 0), (0, blocks * _BLOCK - frames), (0, 0)))
    chunks, out = padded.reshape(len(u), blocks, -1), np.empty((len(u), blocks, _BLOCK * p))
    batch = max(1, _CACHED // max(1, frames * (m + p)))  # cases that fit the cache
    for start in range(0, len(u), batch):
        rows = slice(start, start + batch)
        states = series_states(block.A, chunks[rows, :-1] @ block.B.T)
        out[rows] = chunks[rows] @ block.D.T
        out[rows] += states @ block.C.T
    return out.reshape(len(u), -1, p)[:, :frames].reshape(*lead, frames, p)


def series_states(A: FloatArray, drive: FloatArray) -> FloatArray:
    """States ``x(j+1) = A x(j) + drive(j)`` from zero, one more than drives (..., steps, n)."""
    steps = drive.shape[-2]
    out = np.zeros((*drive.shape[:-2], steps + 1, drive.shape[-1]))
    if steps:
        first, second = drive[..., ::2, :], drive[..., 1::2, :]
        out[..., ::2, :] = series_states(A @ A, first[..., : steps // 2, :] @ A.T + second)
        out[..., 1::2, :] = out[..., :steps:2, :] @ A.T + first
    return out
