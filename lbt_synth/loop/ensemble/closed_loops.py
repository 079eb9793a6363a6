"""Many closed loops by subloop and by whole delay, with their poles and their stability."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.loop.ensemble.batched_loops import (
    BatchedLoops,
    DelayGroup,
    close_subloop,
    group_by_delay,
)
from lbt_synth.loop.ensemble.subloops import Subloop
from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

_AT_ONCE = 256  # loops that share frequencies


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopGroup:
    """The loops of one subloop that have the same whole delay."""

    mirrors: DelayGroup
    loops: BatchedLoops
    poles: ComplexArray  # (k, s)

    def batches(self, stable: BoolArray) -> Iterator[LoopGroup]:
        """Yield batches of the stable loops, sorted by their distance from instability."""
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
    """Loops with the same sensor and mirror, at p sensor gains and delays."""

    hardware: LoopHardware
    sensor_gains: FloatArray  # (p,)
    subloops: list[tuple[Subloop, list[LoopGroup]]]  # each with its groups, the same rows in all
    stable: BoolArray  # (p,)

    @classmethod
    def of(
        cls,
        subloops: list[Subloop],
        rest: list[FloatArray],
        hardware: LoopHardware,
        sensor_gains: FloatArray,
        delay_frames: FloatArray,
    ) -> ClosedLoops:
        """Close the loops, equal subloops only once; ``rest`` are the states without modes."""
        stable = np.ones(sensor_gains.size, dtype=np.bool_)
        for A in rest:
            if A.shape[-1]:
                stable &= _radius(np.linalg.eigvals(A).astype(np.complex128)) < 1 - STABILITY_MARGIN
        closed: list[tuple[Subloop, list[LoopGroup]]] = []
        for subloop in subloops:
            groups = next((known for other, known in closed if other.equals(subloop)), None)
            if groups is None:
                groups = []
                for mirrors in group_by_delay(hardware, delay_frames):
                    loops = close_subloop(subloop, mirrors, sensor_gains[mirrors.rows])
                    poles = np.linalg.eigvals(loops.A).astype(np.complex128)
                    stable[mirrors.rows] &= _radius(poles) < 1 - STABILITY_MARGIN
                    groups.append(LoopGroup(mirrors=mirrors, loops=loops, poles=poles))
            closed.append((subloop, groups))
        return cls(hardware=hardware, sensor_gains=sensor_gains, subloops=closed, stable=stable)

    def by_delay(self) -> Iterator[tuple[IntArray, list[tuple[IntArray, BatchedLoops]]]]:
        """Yield the rows of each whole delay, with the modes and loops of each subloop."""
        for i, group in enumerate(self.subloops[0][1]):
            loops = [(subloop.modes, groups[i].loops) for subloop, groups in self.subloops]
            yield group.mirrors.rows, loops


def _radius(poles: ComplexArray) -> FloatArray:
    return np.asarray(np.max(np.abs(poles), axis=-1))
