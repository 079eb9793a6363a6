"""Banks: many small controllers of the same size, and their loops, as arrays.

In series of closed loops a noise that comes before a sensor of gain g is like a phase: with
``r'(k) = phi_res(k) + noise(k+1) / g`` and ``phi'(k) = phi_tot(k) + noise(k+1) / g`` the loop has
the one input phi', the one output r', and measures ``y(k) = g r'(k-1)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lbt_synth.linear import Controller
from lbt_synth.linear.block_filtering import BatchedSystems
from lbt_synth.loop.closed_loop import loop_matrices
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.validation import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """N systems of the same size that share no mode.

    They are controllers in new-state form, ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D
    y(k)``, or their loops from ``[phi_tot, noise]`` to ``[phi_res, u]``, in textbook form.
    """

    modes: np.ndarray  # (N, w), modes of each system
    A: FloatArray  # (N, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def width(self) -> int:
        """Number of modes w of each system."""
        return int(self.modes.shape[1])

    def take(self, rows: IntArray) -> Bank:
        """Return some of the systems."""
        return Bank(*(getattr(self, part.name)[rows] for part in fields(self)))

    def for_modes(self, modes: np.ndarray) -> Bank:
        """Return the same systems for other modes: i becomes ``modes[i]``."""
        return replace(self, modes=modes[self.modes])

    def textbook(self) -> tuple[FloatArray, ...]:
        """Return controllers in textbook form."""
        return self.A, self.B, self.C @ self.A, self.C @ self.B + self.D

    def close(self, sensor_gain: FloatArray, mirror: Response) -> Bank:
        """Return the loops of controllers, with the sensor gain (n,) of every mode.

        A controller of several modes is alone in its bank.
        """
        w = self.width
        unit = np.eye(w)
        if w == 1:
            sensor, factor = unit, sensor_gain[self.modes][:, :, None]
        else:
            sensor, factor = np.diag(sensor_gain[self.modes[0]]), np.ones((1, 1, 1))
        A0, A1, B, C0, C1, D = loop_matrices(
            *self.textbook(), mirror=mirror, sensor=sensor, influence=unit
        )
        part = slice(2 * w)  # the measurement is left out
        C = C0[:, part] + factor * C1[:, part]
        return Bank(self.modes, A0 + factor * A1, B, C, D[:, part])

    def phase_systems(self) -> tuple[BatchedSystems, BatchedSystems]:
        """Return loops as systems from the phase, to the residual and to the commands."""
        w = self.width
        ends = slice(w), slice(w, 2 * w)
        B, D = self.B[..., :w], self.D[..., :w]
        residual, command = (BatchedSystems(self.A, B, self.C[:, i], D[:, i]) for i in ends)
        return residual, command


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


def filter_phase(
    loops: tuple[Bank, ...],
    systems: tuple[BatchedSystems, ...],
    total: FloatArray,
    scaled: FloatArray,
) -> FloatArray:
    """Return what systems make of phi', with scaled the noise over sensor gain; (n, frames) all."""
    alone = len(loops) == 1 and loops[0].width == 1
    if alone and isinstance(_index(loops[0].modes[:, 0]), slice):
        # all modes in their order: no other array is needed
        phase = _effective_phase(loops[0], total, scaled)
        return systems[0].filter(phase, in_place=True)[:, 1:, 0]
    made = np.empty(total.shape)
    for loop, system in zip(loops, systems, strict=True):
        out = system.filter(_effective_phase(loop, total, scaled))[:, 1:]
        for i, modes in enumerate(loop.modes.T):
            made[_index(modes)] = out[..., i]
    return made


def _effective_phase(loop: Bank, total: FloatArray, scaled: FloatArray) -> FloatArray:
    """Return phi' of some modes, (N, frames + 1, w), for the frames -1, 0, ..."""
    count, w = loop.modes.shape
    out = np.empty((count, total.shape[1] + 1, w))
    for i in range(w):
        which = _index(loop.modes[:, i])
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
