"""Plants of many modes: what :func:`tip_tilt_plant` makes for one, in arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.models import ARModel, ModalTurbulence, Vibration
from lbt_synth.models.mirror.frame_rate_system import Response
from lbt_synth.models.vibration import sampled_lines
from lbt_synth.validation import FloatArray, frozen_copy, integer, real_array

Lines: TypeAlias = tuple[tuple[Vibration, ...], ...]
Vibrations: TypeAlias = Mapping[int, Vibration | Sequence[Vibration]]  # of some modes


def number_per_mode(
    value: Any, name: str, modes: int, *, zero: bool = False, at_most: float = np.inf
) -> FloatArray:
    """Return one positive number per mode, (n,), from one for all or one each."""
    given = real_array(value, name)
    if given.shape not in ((), (modes,)):
        got = f"shape {given.shape}"
        raise DimensionError(f"{name} must be one number, or one per mode ({modes}); got {got}.")
    low, high = float(np.min(given, initial=np.inf)), float(np.max(given, initial=-np.inf))
    if low < 0 or (low == 0 and not zero) or high > at_most:
        bounds = f"{'at least' if zero else 'above'} 0"
        if at_most < np.inf:
            bounds += f" and at most {at_most:g}"
        raise ProblemError(f"{name} must be {bounds}; got {low:.6g} to {high:.6g}.")
    return frozen_copy(np.broadcast_to(given, (modes,)))


def lines_per_mode(vibrations: Vibrations | None, modes: int) -> Lines:
    """Return the vibrations of each mode, from a mapping of some modes."""
    lines: list[tuple[Vibration, ...]] = [()] * modes
    vibrations = {} if vibrations is None else vibrations
    if not isinstance(vibrations, Mapping):
        raise ProblemError(
            "vibrations must be a mapping from mode numbers to vibrations, such as {0: [line]}; "
            f"got {type(vibrations).__name__}."
        )
    for mode, given in vibrations.items():
        i = integer(mode, "a mode of vibrations", at_least=0, at_most=modes - 1)
        each = (given,) if isinstance(given, Vibration) else given
        listed = isinstance(each, list | tuple)
        if not listed or not all(isinstance(line, Vibration) for line in each):
            raise ProblemError(f"mode {i} must have a list of Vibration; got {given!r}.")
        lines[i] = tuple(each)
    return tuple(lines)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlantBatch:
    """Estimation problems of modes that have the same number of states."""

    modes: np.ndarray  # (N,)
    A: FloatArray  # (N, s, s)
    Q: FloatArray  # (N, s, s), covariances of the process noise
    C: FloatArray  # (N, 1, s), to the measurement
    L: FloatArray  # (N, 1, s), to the signal that is estimated
    R: FloatArray  # (N, 1, 1), variances of the measurement noise

    def controllers(self, gains: FloatArray, mirror: Response) -> tuple[FloatArray, ...]:
        """Return controllers ``A, B, C, D`` of predictor gains (N, s, 1), in new-state form.

        As :meth:`FullStatePlant.controller` for one mode: the filters, and the mirror's states.
        """
        count, s = self.A.shape[:2]
        size = s + mirror.n_states
        sensor = self.C[:, :, -1:]  # the measurement is of the oldest phase
        A, (C, L) = np.zeros((count, size, size)), np.zeros((2, count, 1, size))
        A[:, :s, :s], C[..., :s], L[..., :s] = self.A, self.C, self.L
        A[:, s:, s:], C[..., s:] = mirror.A, -sensor * mirror.C
        B, known = np.zeros((2, count, size, 1))
        B[:, :s] = gains
        known[:, s:] = mirror.B[:, None]
        A += (known + mirror.D * B * sensor) @ L - B @ C
        return A, B, L, np.zeros((count, 1, 1))

    def error_systems(self, gains: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state matrices and driving covariances of the estimation errors."""
        A = self.A - gains @ self.C
        return A, self.Q + gains @ self.R @ transpose(gains)


@dataclass(frozen=True, slots=True, eq=False)
class ModalModels:
    """Models of n modes: turbulence, vibrations and measurement noise."""

    turbulence: ModalTurbulence
    lines: Lines
    noise_nm: FloatArray  # (n,)

    @classmethod
    def of(
        cls,
        turbulence: ModalTurbulence | Sequence[ARModel],
        noise_nm: ArrayLike,
        vibrations: Vibrations | None,
        *,
        modes: int | None = None,
    ) -> ModalModels:
        """Check the models; with the number of modes of a loop, the noise may be 0."""
        if not isinstance(turbulence, ModalTurbulence):
            turbulence = ModalTurbulence.of(turbulence)
        n = turbulence.n_modes
        if modes not in (None, n):
            raise DimensionError(f"turbulence must have {modes} modes; got {n}.")
        noise = number_per_mode(noise_nm, "noise_nm", n, zero=modes is not None)
        return cls(turbulence, lines_per_mode(vibrations, n), noise)

    def disturbances(self, modes: np.ndarray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Total phase of some modes as linear systems ``x+ = A x + B v``, ``phi_tot = row x``.

        Return A (N, k, k), B (N, k, p + 1), from white noise of unit variance, and the rows (N, k)
        to the newest sample. The states are vibrations now and before, and turbulence; all systems
        have the size of the one with most vibrations.
        """
        turbulence, lines = self.turbulence, self.lines
        count, order = len(modes), turbulence.order
        p = max((len(lines[i]) for i in modes), default=0)
        size = 2 * p + order
        A, row = np.zeros((count, size, size)), np.zeros((count, size))
        B = np.zeros((count, size, p + 1))
        each = [(i, j, line) for i, mode in enumerate(modes) for j, line in enumerate(lines[mode])]
        if each:
            i, j = np.array([place[:2] for place in each]).T
            numbers = np.array([[x.frequency_hz, x.damping, x.rms_nm] for *_, x in each])
            frequency, damping, rms = numbers.T
            coefficients, driving = sampled_lines(frequency, damping, rms, turbulence.frame_rate_hz)
            A[i, j, j], A[i, j, p + j] = coefficients.T
            B[i, j, j] = driving
        A[:, p : 2 * p, :p] = np.eye(p)
        A[:, 2 * p :, 2 * p :] = turbulence.companions[modes]
        B[:, 2 * p, p] = turbulence.driving_rms_nm[modes]
        row[:, :p] = row[:, 2 * p] = 1
        return A, B, row

    def plants(self, delay_frames: float, sensor_gain: FloatArray) -> list[PlantBatch]:
        """Return the plants of all modes, one batch for each number of vibrations."""
        counts = np.array([len(each) for each in self.lines])
        steps = max(int(np.ceil(delay_frames)), 2)
        late, chain = steps - delay_frames, steps - 1
        batches = []
        for lines_each in np.unique(counts):
            modes = np.flatnonzero(counts == lines_each)
            models, drives, row = self.disturbances(modes)
            count, k = row.shape
            s = k + chain
            A, Q = np.zeros((2, count, s, s))
            A[:, :k, :k], A[:, k, :k] = models, row
            A[:, k + 1 :, k : s - 1] = np.eye(chain - 1)
            Q[:, :k, :k] = drives @ transpose(drives)
            C, L = np.zeros((2, count, 1, s))
            C[:, 0, -1] = sensor_gain[modes]
            L[:, 0, :k], L[:, 0, k] = (1 - late) * row, late
            R = self.noise_nm[modes, None, None] ** 2
            batches.append(PlantBatch(modes=modes, A=A, Q=Q, C=C, L=L, R=R))
        return batches
