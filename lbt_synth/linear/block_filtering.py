"""Filters long series with linear systems, by matrix products over blocks of frames.

Within a block of b frames the outputs are a matrix times (state at the block's
beginning, inputs of the block); the states at the beginnings obey a recursion
with ``A^b``. Two steps of a recursion are one step with the square of its matrix, so that it is
halved until one step is left. The result is that of the frame-by-frame recursion up to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
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
    operators = _block_operators(system.A, system.B, system.C, system.D)
    out = np.empty((cases, frames, p))
    # as many cases at once as fit into the processor's cache
    batch = max(1, _CACHED // max(1, frames * (m + p)))
    for start in range(0, cases, batch):
        part = slice(start, start + batch)
        out[part] = _filter_batch(operators, u[part])
    return out.reshape(*lead, frames, p)


def _filter_batch(operators: _BlockOperators, u: FloatArray) -> FloatArray:
    cases, frames, m = u.shape
    blocks = -(-frames // _BLOCK)  # rounded up
    if frames != blocks * _BLOCK:
        padded = np.zeros((cases, blocks * _BLOCK, m))
        padded[:, :frames] = u
        u = padded
    chunks = u.reshape(cases, blocks, _BLOCK * m)
    starts = _recursion(operators.step, chunks[:, :-1] @ operators.reach)
    out = chunks @ operators.toeplitz
    out += starts @ operators.observe
    return np.asarray(out.reshape(cases, blocks * _BLOCK, -1)[:, :frames])


def last_state(A: FloatArray, drive: FloatArray) -> FloatArray:
    """Compute the state (n,) after the last frame of ``x(k+1) = A x(k) + drive(k)``, from zero.

    The drive (frames, n) is halved repeatedly: two steps of A with two drives are one step of A^2
    with ``A drive + drive``.
    """
    step = A
    while len(drive) > 1:
        if len(drive) % 2:
            drive = np.concatenate([np.zeros((1, drive.shape[1])), drive])
        drive = drive[0::2] @ step.T + drive[1::2]
        step = step @ step
    return drive[0] if len(drive) else np.zeros(len(A))


class _BlockOperators(NamedTuple):
    """Matrices of a block of frames, transposed for row vectors but for ``step``."""

    step: FloatArray  # advances the state by a block
    reach: FloatArray  # from the block's inputs to the state after it
    observe: FloatArray  # from the state before the block to its outputs
    toeplitz: FloatArray  # from the block's inputs to its outputs


def _block_operators(A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray) -> _BlockOperators:
    (p, m), rows, columns = D.shape, [C], [B]  # C A^i, A^i B
    for _ in range(_BLOCK - 1):
        rows.append(rows[-1] @ A)
        columns.append(A @ columns[-1])
    markov = np.zeros((2 * _BLOCK - 1, p, m))  # zeros, D, C B, C A B, ...
    markov[_BLOCK - 1] = D
    markov[_BLOCK:] = np.array(rows[:-1]) @ B
    # entry (j, output, input, i) is that of lag i - j
    late = sliding_window_view(markov, _BLOCK, axis=0)[::-1]
    return _BlockOperators(
        step=np.linalg.matrix_power(A, _BLOCK),
        reach=np.concatenate([column.T for column in reversed(columns)]),
        observe=np.concatenate([row.T for row in rows], axis=1),
        toeplitz=np.reshape(late.transpose(0, 2, 3, 1), (_BLOCK * m, _BLOCK * p)),
    )


def _recursion(A: FloatArray, drive: FloatArray) -> FloatArray:
    """States ``x(j+1) = A x(j) + drive(j)`` from zero, one more than drives (cases, steps, n)."""
    cases, steps, n = drive.shape
    out = np.zeros((cases, steps + 1, n))
    if steps:
        first, second = drive[:, ::2], drive[:, 1::2]
        out[:, ::2] = _recursion(A @ A, first[:, : steps // 2] @ A.T + second)
        out[:, 1::2] = out[:, :steps:2] @ A.T + first
    return out
