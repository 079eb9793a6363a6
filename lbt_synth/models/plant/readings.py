"""What the sensors of a loop read: of a signal that they remember, and of commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.sensor_suite import period_frames
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exposure:
    """Readings of a sensor: the mean of a signal over a period, some frames ago."""

    response: FloatArray  # (q, n)
    age_frames: float  # of the oldest frame that a reading averages
    period: int  # frames from one reading to the next; readings are in frames 0, period, ...


def own_exposure(hardware: LoopHardware) -> Exposure:
    """Return the readings of the loop's own sensor: the residual of the last frame."""
    return Exposure(response=hardware.sensor, age_frames=1.0, period=1)


def other_exposures(hardware: LoopHardware) -> list[Exposure]:
    """Return the readings of the other wavefront sensors of a loop."""
    return [
        Exposure(
            response=sensor.response(hardware.modes),
            age_frames=sensor.age_frames(hardware),
            period=period_frames(sensor, hardware),
        )
        for sensor in hardware.suite.wavefront
    ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Memory:
    """System from a signal to the readings of sensors, of samples before, at each phase."""

    A: FloatArray  # (N, h, h); nothing is remembered where there is no sensor, h = 0
    B: FloatArray  # (N, h, n)
    C: FloatArray  # (N, q, h)

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.A.shape[2])


def memory(exposures: list[Exposure], modes: int, period: int) -> Memory:
    """Return the system from a signal s(k) (n,) to the readings in frame k, of s before k.

    An exposure ends in frame e with the mean of the frames since the last end; the sum of a period
    that has begun and the readings that wait are its states. Where an exposure ends within a frame,
    that frame counts for both exposures, in part.
    """
    blocks = [_exposure_memory(each, modes, period) for each in exposures]
    states = [block[0].shape[1] for block in blocks]
    rows = [block[2].shape[1] for block in blocks]
    A, B = np.zeros((period, sum(states), sum(states))), np.zeros((period, sum(states), modes))
    C = np.zeros((period, sum(rows), sum(states)))
    x = y = 0
    for (a, b, c), n, q in zip(blocks, states, rows, strict=True):
        A[:, x : x + n, x : x + n], B[:, x : x + n], C[:, y : y + q, x : x + n] = a, b, c
        x, y = x + n, y + q
    return Memory(A=A, B=B, C=C)


def _exposure_memory(
    exposure: Exposure, modes: int, period: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C of the memory of one sensor, with states [sum, newest reading, older...]."""
    own, whole = exposure.period, int(np.floor(exposure.age_frames + 1e-9))
    late = exposure.age_frames - whole  # by which the exposure ends before its last frame does
    late = 0.0 if late < 1e-9 else late
    held = 1 + (whole - own) // own  # readings that wait when one is taken
    sums = int(own > 1 or late > 0)  # states before the readings
    size = sums + held
    ends = (own - whole - 1) % own  # frame of the period in which an exposure ends
    A, B = np.zeros((period, size, size)), np.zeros((period, size))
    for t in range(period):
        if t % own == ends:
            B[t, sums] = (1 - late) / own
            A[t, sums + 1 :, sums:-1] = np.eye(held - 1)
            if sums:
                A[t, 1, 0], B[t, 0] = 1.0, late / own
        else:
            A[t], B[t, :sums] = np.eye(size), 1 / own
    C = np.zeros((len(exposure.response), size * modes))
    C[:, -modes:] = exposure.response
    each = np.eye(modes)
    stack = np.broadcast_to(C, (period, *C.shape))
    return np.asarray(np.kron(A, each)), np.asarray(np.kron(B[:, :, None], each)), stack


def known_states(hardware: LoopHardware) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D of what commands make: the mirror's states, and corrections that wait.

    They are stacks (N, ...). In frame k they are driven by u(k-1), so that the corrections
    remembered are those before k - 1, and the reading adds the one of k - 1. The measurements are
    those of all sensors.
    """
    waiting = memory(other_exposures(hardware), hardware.modes, hardware.period)
    mirror = hardware.mirror_system.whole
    A_m, B_m, C_m = mirror.repeated(hardware.n_commands)
    position, direct = hardware.influence @ C_m, mirror.D * hardware.influence
    period, v, w = len(waiting.A), len(A_m), waiting.n_states
    last = np.roll(np.arange(period), 1)  # the phase before
    A, B = np.zeros((period, v + w, v + w)), np.zeros((period, v + w, hardware.n_commands))
    A[:, :v, :v], B[:, :v] = A_m, B_m
    A[:, v:, v:], A[:, v:, :v] = waiting.A[last], waiting.B[last] @ position
    B[:, v:] = waiting.B[last] @ direct
    q0, q1 = hardware.n_measurements, waiting.C.shape[1]
    C = np.zeros((period, hardware.n_readings, v + w))
    D = np.zeros((period, hardware.n_readings, hardware.n_commands))
    C[:, :q0, :v], C[:, q0 : q0 + q1] = -hardware.sensor @ position, -waiting.C @ A[:, v:]
    D[:, :q0], D[:, q0 : q0 + q1] = -hardware.sensor @ direct, -waiting.C @ B[:, v:]
    return A, B, C, D
