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


def residual_system(block: LoopBlock) -> BatchedSystems:
    """Return the systems of a block from the phase to the residual."""
    w = block.modes.shape[1]
    return BatchedSystems(block.A, block.B[..., :w], block.C[:, :w], block.D[:, :w, :w])


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
    residual = np.empty(total.shape)
    commands = np.empty(total.shape) if with_commands else None
    for block, system in zip(blocks, systems, strict=True):
        w = block.modes.shape[1]
        if with_commands:
            system = BatchedSystems(block.A, block.B[..., :w], block.C, block.D[..., :w])
        out = system.filter(_effective_phase(block, total, scaled))[:, 1:]
        for i in range(w):
            which = _index(block.modes[:, i])
            residual[which] = out[..., i]
            residual[which, :-1] -= scaled[which, 1:]
            if commands is not None:
                commands[which] = out[..., w + i]
    return residual, commands


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
