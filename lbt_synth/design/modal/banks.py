"""Banks: many small controllers of the same size, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from lbt_synth.linear import Controller
from lbt_synth.validation import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """N controllers of the same size that share no mode.

    They are in new-state form, ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``.
    """

    modes: np.ndarray  # (N, w), modes of each controller
    A: FloatArray  # (N, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def width(self) -> int:
        """Number of modes w of each controller."""
        return int(self.modes.shape[1])

    def take(self, rows: IntArray) -> Bank:
        """Return some of the controllers."""
        return Bank(*(getattr(self, part.name)[rows] for part in fields(self)))

    def for_modes(self, modes: np.ndarray) -> Bank:
        """Return the same controllers for other modes: i becomes ``modes[i]``."""
        return replace(self, modes=modes[self.modes])

    def textbook(self) -> tuple[FloatArray, ...]:
        """Return ``A, B, C, D`` in textbook form."""
        return self.A, self.B, self.C @ self.A, self.C @ self.B + self.D


def make_banks(controllers: Sequence[Controller], which: np.ndarray) -> tuple[Bank, ...]:
    """Return the controllers of single modes, mode i that of ``which[i]``, by their sizes."""
    sizes = np.array([controller.n_states for controller in controllers])
    out = []
    for size in np.unique(sizes):
        alike = np.flatnonzero(sizes == size)
        modes = np.flatnonzero(np.isin(which, alike))
        place = np.searchsorted(alike, which[modes])
        stacks = (
            np.stack([getattr(controllers[i], name) for i in alike.tolist()])[place]
            for name in "ABCD"
        )
        out.append(Bank(modes[:, None], *stacks))
    return tuple(out)
