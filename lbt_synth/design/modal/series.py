"""Series of the closed loops of many modes, each filtered once.

A noise that comes before a sensor of gain g is like a phase: with
``r'(k) = phi_res(k) + noise(k+1) / g`` and ``phi'(k) = phi_tot(k) + noise(k+1) / g`` the loop has
the one input phi', the one output r', and measures ``y(k) = g r'(k-1)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lbt_synth.design.modal.closed_loops import LoopBlock
from lbt_synth.loop.simulation.block_filtering import BatchedSystems
from lbt_synth.validation import FloatArray


def phase_system(block: LoopBlock, outputs: int) -> BatchedSystems:
    """Return the systems of a block from the phase to its first outputs, the residual first."""
    w = block.modes.shape[1]
    return BatchedSystems(block.A, block.B[..., :w], block.C[:, :outputs], block.D[:, :outputs, :w])


def filter_phase(
    blocks: tuple[LoopBlock, ...],
    systems: tuple[BatchedSystems, ...],
    total: FloatArray,
    scaled: FloatArray,
    *,
    with_commands: bool,
) -> tuple[FloatArray, FloatArray | None]:
    """Return the residuals of all modes, and the commands on request.

    Shapes: total, scaled (noise over sensor gain), residuals, commands (n, frames).
    """
    if len(blocks) == 1 and not with_commands:
        modes = blocks[0].modes
        if modes.shape[1] == 1 and isinstance(_index(modes[:, 0]), slice):
            # all modes in their order: no other array is needed
            joined = _effective_phase(blocks[0], total, scaled)
            only = systems[0].filter(joined, in_place=True)[:, 1:, 0]
            only[:, :-1] -= scaled[:, 1:]
            return only, None
    series = [np.empty(total.shape) for _ in range(2 if with_commands else 1)]
    for block, system in zip(blocks, systems, strict=True):
        w = block.modes.shape[1]
        if with_commands:
            system = phase_system(block, 2 * w)
        out = system.filter(_effective_phase(block, total, scaled))[:, 1:]
        for i in range(w):
            which = _index(block.modes[:, i])
            for k, target in enumerate(series):
                target[which] = out[..., k * w + i]
            series[0][which, :-1] -= scaled[which, 1:]
    return series[0], series[1] if with_commands else None


def _effective_phase(block: LoopBlock, total: FloatArray, scaled: FloatArray) -> FloatArray:
    """Return phi' of a block's modes, (N, frames + 1, w), for the frames -1, 0, ..."""
    count, w = block.modes.shape
    out = np.empty((count, total.shape[1] + 1, w))
    for i in range(w):
        which = _index(block.modes[:, i])
        noise, entry = scaled[which], out[:, :, i]
        entry[:, 0] = noise[:, 0]
        np.add(total[which, :-1], noise[:, 1:], out=entry[:, 1:-1])
        entry[:, -1] = total[which, -1]
    return out


def _index(modes: np.ndarray) -> Any:
    """Return the modes, as a slice where they are consecutive, so that nothing is copied."""
    first, last = int(modes[0]), int(modes[-1])
    consecutive = last - first + 1 == modes.size and np.all(np.diff(modes) == 1)
    return slice(first, last + 1) if consecutive else modes
