"""The plant that several sensors see: the loop's own plant, with what the others remember.

The state is that of :class:`TipTiltPlant` without the vibrations that accelerometers see, then that
of these (:class:`SeenVibration`), then the sums and waiting readings of the wavefront sensors. The
measurements are those of the loop's own sensor, of the other wavefront sensors, and of the
channels, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.models.fusion.seen_vibration import seen_vibration
from lbt_synth.models.fusion.sensors import (
    Motions,
    SensorSuite,
    checked_motions,
    period_frames,
)
from lbt_synth.models.loop_hardware import LoopHardware
from lbt_synth.models.plant.parts import held_frames
from lbt_synth.models.plant.tip_tilt import TipTiltPlant
from lbt_synth.storage.rows import fact_table
from lbt_synth.storage.summaries import Summary
from lbt_synth.storage.words import count_text
from lbt_synth.validation import BoolArray, FloatArray, require_instance


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FusedPlant(EstimationProblem):
    """A plant whose total phase is measured by several sensors; made by :func:`fused_plant`."""

    own: TipTiltPlant  # the plant of the loop's own sensor
    suite: SensorSuite  # the other sensors
    motions: Motions  # for each vibration, the :class:`Motion` of each channel that it moves
    A_known: FloatArray  # (N, k, k): transition of the known states
    # how the last command u(k-1) drives the states of mirror and corrections, how measurements see
    # these, and how they see the command itself
    B_known: FloatArray
    C_known: FloatArray
    D_known: FloatArray

    def _brief(self) -> str:
        sensors = count_text(len(self.suite.units), "sensor")
        return f"{self.own._brief()}, {sensors}, period {self.period}"

    def _summarise(self) -> Summary:
        return Summary(tables=[fact_table("Plant", self.own.hardware.facts())])

    def unit_rows(self, units: tuple[str, ...]) -> BoolArray:
        """Return which measurements some sensors or channels give, (q,)."""
        return self.suite.marked(units, self.own.hardware)

    def controller(self, gain_predictor: FloatArray) -> Controller:
        """Return the controller from all measurements to u(k), in new-state form.

        Its states are the estimates of the plant's states, and the known ones. Entries of a
        measurement that is not read do not matter: their gains are zero.

        Shapes: gain_predictor (N, n, q), or (n, q).
        """
        used = self._checked_gain(gain_predictor)
        to_command = np.zeros((self.own.hardware.n_commands, self.n_states + self.n_known))
        to_command[:, : self.n_states] = self.own.hardware.projector @ self.L
        n, size = self.n_states, self.n_states + self.n_known
        A = np.zeros((self.period, size, size))
        B = np.zeros((self.period, size, self.n_measurements))
        A[:, :n, :n], A[:, :n, n:] = self.A - used @ self.C, -used @ self.C_known
        A[:, n:, n:], B[:, :n] = self.A_known, used
        applied = np.concatenate([-used @ self.D_known, self.B_known], axis=1)
        return Controller(
            A=A + applied @ to_command,
            B=B,
            C=to_command,
            D=np.zeros((len(to_command), self.n_measurements)),
            dt_s=self.dt_s,
        )

    @property
    def n_known(self) -> int:
        """Number of states that the commands make: of the mirror, and corrections that wait."""
        return int(self.A_known.shape[1])


def fused_plant(own: TipTiltPlant, suite: SensorSuite, motions: Motions = ()) -> FusedPlant:
    """Return the plant of a loop that has other sensors beside its own.

    Parameters
    ----------
    own : TipTiltPlant
        Loop, turbulence, vibrations, and the noise of the loop's own sensor.
    suite : SensorSuite
        The other sensors.
    motions : tuple of mapping, optional
        For each vibration of the plant, in order, the :class:`Motion` of each channel that it
        moves; by default no channel moves.

    Returns
    -------
    FusedPlant
        The plant, of the common period of all sensors.

    Raises
    ------
    ProblemError
        If a rate is not a fraction of the frame rate, a delay is too short, or names or sizes
        clash.

    Examples
    --------
    A 20 Hz line that shakes tip by 500 nm, and the mirror's accelerometer by 1000 nm:

    >>> import lbt_synth as lbt
    >>> from lbt_synth.models.fusion.plant import fused_plant
    >>> from lbt_synth.models.fusion.sensors import Accelerometer, Motion, SensorSuite
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=80, frame_rate_hz=1000)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=500, direction=(1,))
    >>> own = lbt.tip_tilt_plant(
    ...     frame_rate_hz=1000, turbulence=slow, vibrations=[line], noise_nm=15, modes=1
    ... )
    >>> mirror = Accelerometer(
    ...     name="mirror", rate_hz=1000, delay_frames=1, channels=("m1",), noise_m_s2=2e-4
    ... )
    >>> plant = fused_plant(own, SensorSuite(sensors=(mirror,)), ({"m1": Motion(size=2)},))
    >>> plant.period, plant.n_states, plant.n_measurements
    (1, 6, 2)
    """
    require_instance(own, TipTiltPlant, "own")
    require_instance(suite, SensorSuite, "suite")
    hardware = own.hardware
    motions = checked_motions(motions or ({},) * len(own.vibrations), suite, len(own.vibrations))
    period = suite.period(hardware)
    # the plant's state is that of the frame in which u(k) acts: older readings by so many frames
    ahead = held_frames(hardware) - 1
    exposures = suite_exposures(suite, hardware)
    late = [replace(each, age_frames=each.age_frames + ahead) for each in exposures]
    waiting = memory(late, hardware.modes, period)
    corrections = memory(exposures, hardware.modes, period)
    shaken = _shaken_plant(own, suite, motions, ahead)
    total = own.A[_newest_total(own)]  # total(k) from x(k): it is that held in x(k+1)

    n, w = shaken.A.shape[1], waiting.n_states
    to_own = np.hstack([shaken.to_own, np.zeros((own.n_states, w))])
    A = np.zeros((period, n + w, n + w))
    A[:, :n, :n], A[:, n:, n:] = shaken.A, waiting.A
    A[:, n:] += waiting.B @ (total @ to_own)
    q0, q1, q2 = len(own.C), waiting.C.shape[1], len(shaken.C)
    C = np.zeros((period, q0 + q1 + q2, n + w))
    C[:, :q0], C[:, q0 : q0 + q1, n:], C[:, q0 + q1 :, :n] = own.C @ to_own, waiting.C, shaken.C
    noise = suite.noise_factor(own.parts().noise_factor, hardware.modes)
    drives = shaken.B.shape[1]
    B, D = np.zeros((n + w, drives + len(noise))), np.zeros((len(noise), drives + len(noise)))
    B[:n, :drives], D[:, drives:] = shaken.B, noise
    A_known, B_known, C_known, D_known = _known_part(own, corrections, q2)
    return FusedPlant(
        A=A,
        B=B,
        C=C,
        D=D,
        L=own.L @ to_own,
        read=suite.read(hardware),
        dt_s=own.dt_s,
        own=own,
        suite=suite,
        motions=motions,
        A_known=A_known,
        B_known=B_known,
        C_known=C_known,
        D_known=D_known,
    )


def _newest_total(own: TipTiltPlant) -> slice:
    """Return where the plant's state holds total(k-1)."""
    parts = own.parts()
    start = 2 * len(parts.vibrations) + parts.order * parts.hardware.modes
    return slice(start, start + parts.hardware.modes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ShakenPlant:
    """A plant whose vibrations are those that accelerometers see, where they see them."""

    A: FloatArray  # (N, n, n)
    B: FloatArray  # (n, w): from white noise, without that of sensors
    C: FloatArray  # (c, n): what channels read
    to_own: FloatArray  # (n0, n): to the states of the loop's own plant, older samples left out


def _shaken_plant(
    own: TipTiltPlant, suite: SensorSuite, motions: Motions, ahead: int
) -> _ShakenPlant:
    p, q0, period = len(own.vibrations), len(own.C), suite.period(own.hardware)
    seen = [j for j, motion in enumerate(motions) if motion]
    lines = [
        seen_vibration(
            own.vibrations[j], motions[j], suite.accelerometers, own.hardware, ahead=ahead
        )
        for j in seen
    ]
    kept = np.delete(np.arange(own.n_states), [*seen, *(p + j for j in seen)])
    drives = np.delete(np.arange(own.B.shape[1] - q0), seen)
    size, width = len(kept) + sum(s.n_states for s in lines), len(drives)
    to_own, C = np.zeros((own.n_states, size)), np.zeros((len(suite.channels), size))
    to_own[kept, : len(kept)] = np.eye(len(kept))
    A = np.zeros((period, size, size))
    B = np.zeros((size, width + sum(s.B.shape[-1] for s in lines)))
    B[: len(kept), :width] = own.B[np.ix_(kept, drives)]
    row = len(kept)
    for j, line in zip(seen, lines, strict=True):
        line_A, line_B, line_C, _ = line.stacks()
        states, moved = slice(row, row + line.n_states), line.B.shape[-1]
        A[:, states, states] = line_A[np.arange(period) % line.period]
        B[states, width : width + moved] = line_B[0]
        to_own[j, states] = line_C[0, 0]
        channels = [i for i, name in enumerate(suite.channels) if name in motions[j]]
        C[channels, states] = line_C[0, 1:]
        row, width = states.stop, width + moved
    A[:, : len(kept)] = own.A[kept] @ to_own
    return _ShakenPlant(A=A, B=B, C=C, to_own=to_own)


def _known_part(
    own: TipTiltPlant, waiting: Memory, channels: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D of the known states: those of the mirror, and its corrections that wait.

    In frame k they are driven by u(k-1), so that the corrections remembered are those before
    k - 1, and the reading adds the one of k - 1.
    """
    hardware = own.hardware
    mirror = hardware.mirror_system.whole
    A_m, B_m, C_m = mirror.repeated(hardware.n_commands)
    seen, direct = hardware.influence @ C_m, mirror.D * hardware.influence
    period, v, w = len(waiting.A), len(A_m), waiting.n_states
    last = np.roll(np.arange(period), 1)  # the phase before
    A, B = np.zeros((period, v + w, v + w)), np.zeros((period, v + w, hardware.n_commands))
    A[:, :v, :v], B[:, :v] = A_m, B_m
    A[:, v:, v:], A[:, v:, :v] = waiting.A[last], waiting.B[last] @ seen
    B[:, v:] = waiting.B[last] @ direct
    C = -np.concatenate(
        [
            np.broadcast_to(
                np.hstack([hardware.sensor @ seen, np.zeros((len(hardware.sensor), w))]),
                (period, len(hardware.sensor), v + w),
            ),
            waiting.C @ A[:, v:],
            np.zeros((period, channels, v + w)),
        ],
        axis=1,
    )
    D = -np.concatenate(
        [
            np.broadcast_to(
                hardware.sensor @ direct, (period, len(hardware.sensor), hardware.n_commands)
            ),
            waiting.C @ B[:, v:],
            np.zeros((period, channels, hardware.n_commands)),
        ],
        axis=1,
    )
    return A, B, C, D
