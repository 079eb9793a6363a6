"""Banks: many small controllers of the same size, run and closed into loops together.

In series of closed loops a noise that comes before a sensor of gain g is like a phase: with
``r'(k) = phi_res(k) + noise(k+1) / g`` and ``phi'(k) = phi_tot(k) + noise(k+1) / g`` the loop has
the one input phi', the one output r', and measures ``y(k) = g r'(k-1)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from lbt_synth.design.modal.plants import ModalModels
from lbt_synth.errors import DimensionError
from lbt_synth.linear.block_filtering import BatchedSystems
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.loop.closed_loop import loop_matrices
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.validation import FloatArray, float_array


@dataclass(frozen=True, slots=True, eq=False)
class ModalSystems:
    """A stack of N systems that share no mode."""

    modes: np.ndarray  # (N, w), modes of each system
    A: FloatArray  # (N, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray

    @property
    def width(self) -> int:
        """Number of modes w of each system."""
        return int(self.modes.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class Bank(ModalSystems):
    """Controllers in new-state form, ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``.

    B is (N, s, w), C (N, w, s) and D (N, w, w).
    """

    def for_modes(self, modes: np.ndarray) -> Bank:
        """Return the same controllers for other modes: i becomes ``modes[i]``."""
        return replace(self, modes=modes[self.modes])


@dataclass(slots=True, eq=False)
class RunningBanks:
    """Banks with their states: ``step(y) -> u`` once a frame, and ``reset()``.

    Every mode belongs to one controller.
    """

    banks: Sequence[Bank]
    n_modes: int
    _states: list[FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Set all states to zero."""
        self._states = [np.zeros((len(bank.A), bank.A.shape[-1], 1)) for bank in self.banks]

    def step(self, y: Any) -> FloatArray:
        """Take the measurements y(k), (n,), and return the commands u(k), (n,)."""
        measured = float_array(y, "y")
        if measured.shape != (self.n_modes,):
            raise DimensionError(f"y must have shape ({self.n_modes},); got {measured.shape}.")
        command = np.zeros(self.n_modes)
        for i, bank in enumerate(self.banks):
            entry = measured[bank.modes][..., None]
            self._states[i] = bank.A @ self._states[i] + bank.B @ entry
            command[bank.modes] = (bank.C @ self._states[i] + bank.D @ entry)[..., 0]
        return command


class LoopVariances(NamedTuple):
    """Variances that the loops of a block leave, and the errors of their computation."""

    variances: FloatArray  # (N, w), of each mode's residual
    residuals: FloatArray  # (N,), relative, of the Lyapunov equations
    rounding: FloatArray  # (N,), what it may have done to the variances, relative


@dataclass(frozen=True, slots=True, eq=False)
class LoopBlock(ModalSystems):
    """Closed loops of one bank, from ``[phi_tot, noise]`` to ``[phi_res, u]``, in textbook form.

    B is (N, s, 2 w), C (N, 2 w, s) and D (N, 2 w, 2 w).
    """

    @property
    def spectral_radii(self) -> FloatArray:
        """Spectral radius of each loop, (N,)."""
        return np.asarray(np.abs(np.linalg.eigvals(self.A)).max(axis=-1))

    def variances(self, models: ModalModels) -> LoopVariances:
        """Exact variances under models and white noise: Lyapunov equations of loops and models.

        The variances are small differences where a process is nearly a random walk.
        """
        count, w = self.modes.shape
        n = self.A.shape[-1]
        systems, drives, rows = models.disturbances(self.modes.ravel())
        k, p = drives.shape[1:]
        systems, drives = systems.reshape(count, w, k, k), drives.reshape(count, w, k, p)
        rows = rows.reshape(count, w, 1, k)
        A = np.zeros((count, n + w * k, n + w * k))
        B = np.zeros((count, n + w * k, w + w * p))
        C, D = np.zeros((count, w, n + w * k)), np.zeros((count, w, w + w * p))
        noise = models.noise_nm[self.modes][:, None, :]
        A[:, :n, :n], C[..., :n] = self.A, self.C[:, :w]
        B[:, :n, :w], D[..., :w] = self.B[..., w:] * noise, self.D[:, :w, w:] * noise
        for i in range(w):
            x, v = slice(n + i * k, n + (i + 1) * k), slice(w + i * p, w + (i + 1) * p)
            A[:, :n, x] = self.B[..., i : i + 1] @ rows[:, i]
            C[..., x] = self.D[:, :w, i : i + 1] @ rows[:, i]
            A[:, x, x], B[:, x, v] = systems[:, i], drives[:, i]
        P, residuals = stationary_covariances(A, B @ transpose(B))
        output = C @ P @ transpose(C) + D @ transpose(D)
        variances = np.diagonal(output, axis1=-2, axis2=-1).copy()
        sizes = np.abs(C) @ np.abs(P) @ np.abs(transpose(C))
        sizes = np.diagonal(sizes, axis1=-2, axis2=-1) + np.sum(D**2, axis=-1)
        small = np.finfo(float).tiny  # no disturbance: 0, and nothing is lost
        rounding = np.finfo(float).eps * np.max(sizes / np.maximum(variances, small), axis=-1)
        return LoopVariances(variances, residuals, np.asarray(rounding))

    def phase_system(self, outputs: int) -> BatchedSystems:
        """Return the systems from the phase to the first outputs, the residual first."""
        w = self.width
        return BatchedSystems(self.A, self.B[..., :w], self.C[:, :outputs], self.D[:, :outputs, :w])


def close_bank(bank: Bank, sensor_gain: FloatArray, mirror: Response) -> LoopBlock:
    """Close the loops of a bank, with the sensor gain (n,) of every mode.

    A controller of several modes is alone in its bank, or all its modes have one gain.
    """
    w = bank.width
    unit = np.eye(w)
    if w == 1:
        sensor, factor = unit, sensor_gain[bank.modes][:, :, None]
    else:
        sensor, factor = np.diag(sensor_gain[bank.modes[0]]), np.ones((1, 1, 1))
    textbook = bank.A, bank.B, bank.C @ bank.A, bank.C @ bank.B + bank.D
    A0, A1, B, C0, C1, D = loop_matrices(*textbook, mirror=mirror, sensor=sensor, influence=unit)
    part = slice(2 * w)  # the measurement is left out
    C = C0[:, part] + factor * C1[:, part]
    return LoopBlock(bank.modes, A0 + factor * A1, B, C, D[:, part])


def filter_phase(
    blocks: tuple[LoopBlock, ...],
    systems: tuple[BatchedSystems, ...],
    total: FloatArray,
    scaled: FloatArray,
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
        w = block.width
        if with_commands:
            system = block.phase_system(2 * w)
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
