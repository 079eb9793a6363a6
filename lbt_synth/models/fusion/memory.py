"""What wavefront sensors remember of the residual: sums over exposures, and readings that wait."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear.periodic.system import PeriodicSystem
from lbt_synth.models.fusion.sensors import SensorSuite, period_frames
from lbt_synth.models.loop_hardware import LoopHardware
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


def suite_exposures(suite: SensorSuite, hardware: LoopHardware) -> list[Exposure]:
    """Return the readings of the wavefront sensors of a suite."""
    return [
        Exposure(
            response=sensor.response(hardware.modes),
            age_frames=sensor.age_frames(hardware),
            period=period_frames(sensor, hardware),
        )
        for sensor in suite.wavefront
    ]


def memory(exposures: list[Exposure], modes: int, period: int, dt_s: float) -> PeriodicSystem:
    """Return the system from a signal s(k) (n,) to the readings in frame k, of s before k.

    An exposure ends in frame e with the mean of the frames since the last end; the sum of a period
    that has begun and the readings that wait are its states. Where an exposure ends within a frame,
    that frame counts for both exposures, in part.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.models.fusion.memory import Exposure, memory
    >>> pair = Exposure(response=np.eye(1), age_frames=2.0, period=2)
    >>> mean = memory([pair], 1, 2, 1.0).lifted()  # reads (s(-2) + s(-1)) / 2 in frame 0
    >>> mean.C[0].tolist(), mean.B[-1].tolist()
    ([0.0, 1.0], [0.5, 0.5])
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
    D = np.zeros((period, sum(rows), modes))
    return PeriodicSystem(A=A, B=B, C=C, D=D, dt_s=dt_s)


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
