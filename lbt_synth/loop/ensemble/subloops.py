"""A loop split into independent subloops, such as tip and tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_ROUNDING = 1e-13  # smaller entries, relative to the largest of their matrix, count as zero
_SAME = 1e-11  # relative difference up to which two subloops are the same


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Subloop:
    """Some modes of a loop, and all that depends on them.

    The controllers ``A, B, C, D`` are in textbook form, (N, ., .) each: one for all loops, or one
    per loop.
    """

    modes: IntArray  # indices in the whole loop
    measurements: IntArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    sensor: FloatArray  # (q, n)
    influence: FloatArray  # (n, m)

    @property
    def is_shared(self) -> bool:
        """Whether one controller serves all loops."""
        return len(self.A) == 1

    def controllers(self, rows: IntArray) -> tuple[FloatArray, ...]:
        """Return the controllers ``A, B, C, D`` of some loops, or the one that serves all."""
        matrices = self.A, self.B, self.C, self.D
        return matrices if self.is_shared else tuple(matrix[rows] for matrix in matrices)

    def equals(self, other: Subloop) -> bool:
        """Whether another subloop behaves the same, to rounding."""
        names = ("A", "B", "C", "D", "sensor", "influence")
        pairs = [(getattr(self, name), getattr(other, name)) for name in names]
        return all(
            one.shape == two.shape
            and np.allclose(one, two, rtol=0, atol=_SAME * np.max(np.abs(one), initial=0.0))
            for one, two in pairs
        )


def split_into_subloops(
    matrices: tuple[FloatArray, ...], hardware: LoopHardware
) -> tuple[list[Subloop], list[FloatArray]]:
    """Split a loop into independent subloops, and the state matrices that reach no mode.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.loop.ensemble.subloops import split_into_subloops
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> textbook = lbt.integrator(path, gain=0.5).controller.to_statespace()
    >>> matrices = tuple(m[None] for m in (textbook.A, textbook.B, textbook.C, textbook.D))
    >>> [subloop.modes.tolist() for subloop in split_into_subloops(matrices, path)[0]]
    [[0], [1]]
    """
    A, B, C, D = matrices
    sensor, influence = hardware.sensor, hardware.influence
    s, q, m, n = A.shape[-1], B.shape[-1], C.shape[-2], hardware.modes
    x, y, u, r = np.split(np.arange(s + q + m + n), np.cumsum([s, q, m]))
    links = np.zeros((s + q + m + n, s + q + m + n), dtype=np.bool_)
    controller = (x, x, A), (x, y, B), (u, x, C), (u, y, D)
    for rows, columns, entries in (*controller, (y, r, sensor[None]), (r, u, influence[None])):
        links[np.ix_(rows, columns)] = _nonzero_entries(entries)
    _, label = connected_components(csr_matrix(links), directed=False)
    subloops, rest = [], []
    for each in np.unique(label):
        own = label == each
        states, modes = np.flatnonzero(own[x]), np.flatnonzero(own[r])
        inputs, commands = np.flatnonzero(own[y]), np.flatnonzero(own[u])
        if modes.size == 0:
            rest.append(A[:, states[:, None], states])
            continue
        subloops.append(
            Subloop(
                modes=modes,
                measurements=inputs,
                A=A[:, states[:, None], states],
                B=B[:, states[:, None], inputs],
                C=C[:, commands[:, None], states],
                D=D[:, commands[:, None], inputs],
                sensor=sensor[np.ix_(inputs, modes)],
                influence=influence[np.ix_(modes, commands)],
            )
        )
    return subloops, rest


def _nonzero_entries(entries: FloatArray) -> BoolArray:
    """Which entries are more than rounding in any of the matrices (N, ., .)."""
    sizes = np.abs(entries)
    largest = np.max(sizes, axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray(np.any(sizes > _ROUNDING * largest, axis=0))
