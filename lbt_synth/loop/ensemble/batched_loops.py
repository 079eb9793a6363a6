"""One subloop closed at many sensor gains and delays, as arrays of state matrices.

Between two whole delays a settled mirror shows the commands of two frames within an exposure,
so that every matrix of the loop is affine in the fraction, as it is in the sensor gain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.loop.closed_loop import loop_matrices
from lbt_synth.loop.ensemble.subloops import Subloop
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import Response, tapped_mirror
from lbt_synth.validation import ComplexArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DelayGroup:
    """Loops whose mirror is ``(1 - fraction) first + fraction second``."""

    rows: IntArray  # which loops, (k,)
    fraction: FloatArray  # (k,)
    first: Response  # the two mirrors have the same states
    second: Response

    def take(self, which: IntArray) -> DelayGroup:
        """Return some of the group's loops."""
        return replace(self, rows=self.rows[which], fraction=self.fraction[which])


def group_by_delay(hardware: LoopHardware, delay_frames: FloatArray) -> Iterator[DelayGroup]:
    """Yield the loops by the whole part of their delay, or by their delay with a moving mirror."""
    if hardware.mirror is None:
        lead = np.floor(delay_frames - 1).astype(np.int64)
        fraction = delay_frames - 1 - lead
        for whole in np.unique(lead):
            rows = np.flatnonzero(lead == whole)
            count = whole + (2 if np.any(fraction[rows] > 0) else 1)
            taps = np.zeros((2, count))
            taps[0, whole] = taps[1, -1] = 1.0
            yield DelayGroup(
                rows=rows,
                fraction=fraction[rows],
                first=tapped_mirror(taps[0]),
                second=tapped_mirror(taps[1]),
            )
        return
    for delay in np.unique(delay_frames):
        mirror = replace(hardware, delay_frames=float(delay)).mirror_system.whole
        rows = np.flatnonzero(delay_frames == delay)
        yield DelayGroup(rows=rows, fraction=np.zeros(rows.size), first=mirror, second=mirror)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BatchedLoops:
    """Closed loops from ``[phi_tot (n), noise (q)]`` to ``phi_res (n)``, (k, ., .) each."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    def take(self, which: IntArray) -> BatchedLoops:
        """Return some of the loops."""
        return BatchedLoops(A=self.A[which], B=self.B[which], C=self.C[which], D=self.D[which])

    def rejections(self, turn: FloatArray) -> ComplexArray:
        """Rejection (k, n, n) of each loop at its own frequency [radians a frame]."""
        n = self.C.shape[1]
        pencil = np.exp(1j * turn)[:, None, None] * np.eye(self.A.shape[1]) - self.A
        states = np.linalg.solve(pencil, self.B[..., :n].astype(np.complex128))
        return np.asarray(self.C @ states + self.D[..., :n])


def close_subloop(subloop: Subloop, group: DelayGroup, sensor_gains: FloatArray) -> BatchedLoops:
    """Close a subloop with the delays of a group, at the sensor gains (k,)."""
    controllers = subloop.controllers(group.rows)
    ends = [
        loop_matrices(
            *controllers, mirror=mirror, sensor=subloop.sensor, influence=subloop.influence
        )
        for mirror in (group.first, group.second)
    ]
    share = group.fraction[:, None, None]
    A0, A1, B, C0, C1, D = (
        one if one is two or not group.fraction.any() else one + share * (two - one)
        for one, two in zip(*ends, strict=True)
    )
    gain, n, count = sensor_gains[:, None, None], subloop.modes.size, group.rows.size
    B, D = (np.broadcast_to(m, (count, *m.shape[1:])) for m in (B, D[:, :n]))
    return BatchedLoops(A=A0 + gain * A1, B=B, C=(C0 + gain * C1)[:, :n], D=D)


def join_subloops(subloops: list[BatchedLoops]) -> BatchedLoops:
    """Join independent subloops into block-diagonal loops, driven by the total phase only."""
    if len(subloops) == 1:
        return subloops[0]
    count = len(subloops[0].A)
    s = np.cumsum([0] + [loop.A.shape[1] for loop in subloops])
    n = np.cumsum([0] + [loop.C.shape[1] for loop in subloops])
    A, B = np.zeros((count, s[-1], s[-1])), np.zeros((count, s[-1], n[-1]))
    C, D = np.zeros((count, n[-1], s[-1])), np.zeros((count, n[-1], n[-1]))
    for i, loop in enumerate(subloops):
        x, r = slice(s[i], s[i + 1]), slice(n[i], n[i + 1])
        modes = slice(loop.C.shape[1])
        A[:, x, x], B[:, x, r] = loop.A, loop.B[..., modes]
        C[:, r, x], D[:, r, r] = loop.C, loop.D[..., modes]
    return BatchedLoops(A=A, B=B, C=C, D=D)
