"""Many closed loops, piece by piece and delay by delay, and which of them are stable."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.loop.ensemble.batched_loops import (
    BatchedLoops,
    DelayGroup,
    close_batched_loops,
    group_by_delay,
)
from lbt_synth.loop.ensemble.subloops import Subloop
from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

_AT_ONCE = 256  # loops that share frequencies


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopGroup:
    """Loops of one piece and one whole delay."""

    mirrors: DelayGroup  # Which loops, and their mirrors
    loops: BatchedLoops  # The loops
    poles: ComplexArray  # (k, s): their poles

    def batches(self, stable: BoolArray) -> Iterator[LoopGroup]:
        """Yield the stable loops, those with alike distances from instability together."""
        found = np.flatnonzero(stable[self.mirrors.rows])
        order = found[np.argsort(_radius(self.poles[found]), kind="stable")]
        for start in range(0, order.size, _AT_ONCE):
            which = order[start : start + _AT_ONCE]
            yield LoopGroup(
                mirrors=self.mirrors.take(which),
                loops=self.loops.take(which),
                poles=self.poles[which],
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClosedLoops:
    """Loops of the same sensor and mirror around the pieces of controllers."""

    hardware: LoopHardware  # Sensor and mirror
    sensor_gains: FloatArray  # (p,): real sensor gains
    # list of (LoopPart, list of LoopGroup): each piece with its loops by their whole delays, the
    # same rows for all pieces
    pieces: list[tuple[Subloop, list[LoopGroup]]]
    stable: BoolArray  # (p,): which loops are stable

    @classmethod
    def of(
        cls,
        parts: list[Subloop],
        rest: list[FloatArray],
        hardware: LoopHardware,
        sensor_gains: FloatArray,
        delay_frames: FloatArray,
    ) -> ClosedLoops:
        """Close the loops; pieces that are alike are closed once.

        Shapes: parts, rest list of (N, s, s), sensor_gains, delay_frames (p,).
        """
        stable = np.ones(sensor_gains.size, dtype=np.bool_)
        for A in rest:
            if A.shape[-1]:
                stable &= _radius(np.linalg.eigvals(A).astype(np.complex128)) < 1 - STABILITY_MARGIN
        pieces: list[tuple[Subloop, list[LoopGroup]]] = []
        for part in parts:
            alike = next((groups for other, groups in pieces if other.equals(part)), None)
            if alike is None:
                alike = []
                for mirrors in group_by_delay(hardware, delay_frames):
                    loops = close_batched_loops(part, mirrors, sensor_gains[mirrors.rows])
                    poles = np.linalg.eigvals(loops.A).astype(np.complex128)
                    stable[mirrors.rows] &= _radius(poles) < 1 - STABILITY_MARGIN
                    alike.append(LoopGroup(mirrors=mirrors, loops=loops, poles=poles))
            pieces.append((part, alike))
        return cls(hardware=hardware, sensor_gains=sensor_gains, pieces=pieces, stable=stable)

    @property
    def modes(self) -> int:
        """Number of modes n."""
        return self.hardware.modes

    def by_delay(self) -> Iterator[tuple[IntArray, list[tuple[IntArray, BatchedLoops]]]]:
        """Yield the rows of each whole delay, with the modes and loops of each piece."""
        for whole, group in enumerate(self.pieces[0][1]):
            yield (
                group.mirrors.rows,
                [(part.modes, groups[whole].loops) for part, groups in self.pieces],
            )


def _radius(poles: ComplexArray) -> FloatArray:
    return np.asarray(np.max(np.abs(poles), axis=-1))
