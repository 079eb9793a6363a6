"""A loop taken apart into pieces that know nothing of each other: tip, and tilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from lbt_synth.models import LoopHardware
from lbt_synth.validation import BoolArray, FloatArray, IntArray

_ROUNDING = 1e-13  # entries this much smaller than the largest of their matrix are none
_SAME = 1e-11  # relative difference of pieces that are the same


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Subloop:
    """A piece of a loop: some modes, and all that depends on them."""

    # modes, measurements (n,): which modes and measurements of the loop these are
    modes: IntArray
    measurements: IntArray
    # A, B, C, D (N, s, s): controllers in textbook form: one for all loops, or one each
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    # sensor, influence (q, n): their sensor and influence matrices
    sensor: FloatArray
    influence: FloatArray

    @property
    def is_shared(self) -> bool:
        """Whether one controller serves all loops."""
        return len(self.A) == 1

    @property
    def is_scalar(self) -> bool:
        """Whether it has one mode, one measurement and one command."""
        return self.sensor.shape == self.influence.shape == (1, 1)

    def controllers(self, rows: IntArray) -> tuple[FloatArray, ...]:
        """Return the controllers ``A, B, C, D`` of some loops, one if it serves all."""
        matrices = self.A, self.B, self.C, self.D
        return matrices if self.is_shared else tuple(part[rows] for part in matrices)

    def equals(self, other: Subloop) -> bool:
        """Whether another piece behaves the same, to rounding."""
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
    """Take a loop apart along what does not depend on each other.

    Shapes: returns rest list of (N, s, s).

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.loop.ensemble.subloops import split_into_subloops
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> textbook = lbt.integrator(path, gain=0.5).controller.to_statespace()
    >>> matrices = tuple(m[None] for m in (textbook.A, textbook.B, textbook.C, textbook.D))
    >>> [part.modes.tolist() for part in split_into_subloops(matrices, path)[0]]
    [[0], [1]]
    """
    A, B, C, D = matrices
    sensor, influence = hardware.sensor, hardware.influence
    s, q, m, n = A.shape[-1], B.shape[-1], C.shape[-2], hardware.modes
    x, y, u, r = np.split(np.arange(s + q + m + n), np.cumsum([s, q, m]))
    links = np.zeros((s + q + m + n, s + q + m + n), dtype=np.bool_)
    for rows, columns, entries in (
        (x, x, A),
        (x, y, B),
        (u, x, C),
        (u, y, D),
        (y, r, sensor[None]),
        (r, u, influence[None]),
    ):
        links[np.ix_(rows, columns)] = _nonzero_entries(entries)
    _, label = connected_components(csr_matrix(links), directed=False)
    parts, rest = [], []
    for piece in np.unique(label):
        own = label == piece
        states, modes = np.flatnonzero(own[x]), np.flatnonzero(own[r])
        inputs, commands = np.flatnonzero(own[y]), np.flatnonzero(own[u])
        if modes.size == 0:
            rest.append(A[:, states[:, None], states])
            continue
        parts.append(
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
    return parts, rest


def _nonzero_entries(entries: FloatArray) -> BoolArray:
    """Which entries of a stack are more than rounding, in any of its matrices."""
    sizes = np.abs(entries)
    largest = np.max(sizes, axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray(np.any(sizes > _ROUNDING * largest, axis=0))
