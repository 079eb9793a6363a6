"""A vibration that accelerometers see: a continuous oscillator, in frames and in readings.

The oscillator is ``x'' + 2 zeta w0 x' + w0^2 x = white force``, sampled exactly: C. F. Van Loan,
IEEE Trans. Autom. Control 23, 395 (1978), doi:10.1109/TAC.1978.1101743. Frame k is the time from
k T to (k + 1) T. The total phase of a frame holds the mean position over it, a reading the mean
acceleration over the accelerometer's own exposure: the difference of the velocities at its ends
over its length. Nothing that is read comes later than the end of the exposure.

A channel's complex factor F acts as ``Re(F) a + Im(F) (j a)``. At the line's frequency w an
acceleration is ``a = j w v``, so that ``j a = -w v``, and its mean is the difference of positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import expm

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.matrix_functions import symmetrise
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.sensor_suite import Accelerometer, Motion, period_frames
from lbt_synth.models.vibration import Vibration
from lbt_synth.validation import FloatArray, frozen_copy, set_fields

_DIGITS = 9  # of a part of a frame
_PARALLEL = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenVibration(StateSpace):
    """System from white noise to the mean position in a frame [nm], and readings [m/s^2].

    The first states are the mean position in the newest frame, then position and velocity over w0
    at its end. The first three inputs drive these, whatever channels there are.
    """

    still: FloatArray  # (n, 2): state after a rest at a position and a velocity

    def __post_init__(self) -> None:
        StateSpace.__post_init__(self)
        set_fields(self, still=frozen_copy(self.still))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Exposure:
    """The exposures of an accelerometer to a line.

    An end of an exposure counts by ``basis @ [position, velocity]``; the readings are the weights
    times the difference of two ends.
    """

    period: int  # frames from one end to the next
    age: int  # whole frames from that in which the newest exposure ends to that of the state
    part: float  # of its frame that has passed when an exposure ends
    basis: FloatArray  # (r, 2): what counts of position and velocity
    weights: FloatArray  # (c, r)

    @property
    def waits(self) -> bool:
        """Whether an end is remembered by the frame in which it is read first."""
        return bool(self.age % self.period)

    @property
    def remembered(self) -> int:
        """Number of ends that are states."""
        return self.age // self.period + 1 + self.waits


def seen_vibration(
    line: Vibration,
    motion: Mapping[str, Motion],
    accelerometers: Sequence[Accelerometer],
    hardware: LoopHardware,
    *,
    ahead: int = 0,
) -> SeenVibration:
    """Return a line and what each channel that it moves reads of it, in the channels' order.

    The newest frame of the state comes ``ahead`` frames after that of the readings; the period is
    the common one of the accelerometers that see the line.
    """
    if line.sections > 1:
        raise ProblemError(
            f"a bump of {line.sections} sections moves no channel of an accelerometer; got motions "
            f"of that at {line.frequency_hz:.6g} Hz. Try sections=1, or leave them out."
        )
    exposures = [
        _exposure(line, motion, sensor, hardware, ahead)
        for sensor in accelerometers
        if motion.keys() & set(sensor.channels)
    ]
    parts = sorted({1.0, *(exposure.part for exposure in exposures)})
    frame = _frame_map(line, hardware.dt_s, parts)
    ends = [frame[1 + parts.index(exposure.part)] for exposure in exposures]
    within = [
        exposure.basis @ end
        for exposure, end in zip(exposures, ends, strict=True)
        if exposure.part < 1
    ]
    driven = np.vstack([frame[0], frame[-1], *within])
    size = len(driven) + sum(exposure.remembered * len(exposure.basis) for exposure in exposures)
    period = int(np.lcm.reduce([1, *(exposure.period for exposure in exposures)]))
    A = np.zeros((period, size, size))
    B, still = np.zeros((size, driven.shape[1] - 2)), np.zeros((size, 2))
    A[:, : len(driven), 1:3], B[: len(driven)] = driven[:, :2], driven[:, 2:]
    C, still[1:3] = [np.eye(1, size)], np.eye(2)
    place, row = 3, len(driven)  # of ends within a frame, of ends that are remembered
    for exposure in exposures:
        r = len(exposure.basis)
        newest = np.zeros((r, size))
        if exposure.part < 1:
            newest[:, place : place + r], still[place : place + r] = np.eye(r), exposure.basis
            place += r
        else:
            newest[:, 1:3] = exposure.basis
        rows = slice(row, row + exposure.remembered * r)
        stored = np.eye(size)[rows]
        both = np.vstack([newest, stored])
        for t in range(period):
            A[t, rows] = stored if (t + exposure.age) % exposure.period else both[:-r]
        still[rows] = np.tile(exposure.basis, (exposure.remembered, 1))
        newer, older = (stored if exposure.waits else both).reshape(-1, r, size)[-2:]
        C.append(exposure.weights @ (newer - older))
        row = rows.stop
    output = np.vstack(C)
    return SeenVibration(
        A=A,
        B=B,
        C=output,
        D=np.zeros((len(output), B.shape[1])),
        dt_s=hardware.dt_s,
        still=still,
    )


def _exposure(
    line: Vibration,
    motion: Mapping[str, Motion],
    sensor: Accelerometer,
    hardware: LoopHardware,
    ahead: int,
) -> _Exposure:
    """Return the exposures of an accelerometer that sees a line."""
    period, frequency_hz = period_frames(sensor, hardware), line.frequency_hz
    newest = sensor.age_frames(hardware) - period + 1 + ahead
    age = int(np.floor(newest + 10.0**-_DIGITS))
    factors = np.array(
        [sensor.factor(motion[name], frequency_hz) for name in sensor.channels if name in motion]
    )
    # velocities are over w0, so that an acceleration is w0 times their difference
    scale = 2e-9 * np.pi * frequency_hz / (period * hardware.dt_s)
    left, sizes, right = np.linalg.svd(scale * np.stack([-factors.imag, factors.real], axis=1))
    r = int(np.sum(sizes > _PARALLEL * sizes[0]))
    return _Exposure(
        period=period,
        age=age,
        part=1.0 - round(max(newest - age, 0.0), _DIGITS),
        basis=right[:r],
        weights=left[:, :r] * sizes[:r],
    )


def _frame_map(line: Vibration, dt_s: float, parts: Sequence[float]) -> list[FloatArray]:
    """Return maps (., 2 + 3 m) of state and noise to the mean position, and to m ends of parts."""
    angle, m = 2 * np.pi * line.frequency_hz * dt_s, len(parts)
    ends, now = [], np.eye(3, 2 + 3 * m)  # position, velocity over w0, integral of the position
    now[2] = 0.0
    for i, (start, end) in enumerate(pairwise([0.0, *parts])):
        length = end - start
        transition, factor = _sampled(angle * length, line.damping)
        units = np.array([1.0, 1 / (angle * length), length])
        now = (units[:, None] * transition / units) @ now
        drive = line.rms_nm * np.sqrt(4 * line.damping * (angle * length) ** 3)
        now[:, 2 + 3 * i : 5 + 3 * i] += drive * units[:, None] * factor
        ends.append(now[:2])
    # the noise is turned so that its first three parts give the whole frame, whatever its parts
    turn, root = np.linalg.qr(now[:, 2:].T, mode="complete")
    turn[:, :3] *= np.sign(np.diag(root))
    return [np.hstack([place[:, :2], place[:, 2:] @ turn]) for place in (now[2:], *ends)]


def _sampled(angle: float, damping: float) -> tuple[FloatArray, FloatArray]:
    """Return transition and noise root of [x, x', integral of x] for a force of unit density."""
    rates = np.array([[0.0, 1.0, 0.0], [-(angle**2), -2 * damping * angle, 0.0], [1.0, 0.0, 0.0]])
    generator = np.zeros((6, 6))
    generator[:3, :3], generator[3:, 3:], generator[1, 4] = -rates, rates.T, 1.0
    both = expm(generator)
    transition = both[3:, 3:].T
    return transition, np.asarray(np.linalg.cholesky(symmetrise(transition @ both[:3, 3:])))
