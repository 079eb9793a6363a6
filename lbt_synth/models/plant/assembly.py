"""The matrices of a plant from its parts (Agapito et al. 2008, eqs. 5-7, and other sensors).

Without other sensors the state is the paper's. With some it is that without the vibrations that
accelerometers see, then that of these (:class:`SeenVibration`), then the sums and waiting readings
of the other wavefront sensors. The measurements are those of the loop's own sensor, of the other
wavefront sensors, and of the channels, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.errors import DimensionError
from lbt_synth.models.loop_hardware import LoopHardware, require_loop_rate
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.resonance_spectrum import coefficient_rows, section_drives
from lbt_synth.models.sensor_suite import WHOLE, Motions, checked_motions, period_frames
from lbt_synth.models.spectra import ARModel
from lbt_synth.models.vibration import Vibration, checked_direction
from lbt_synth.validation import FloatArray, require_instance, set_fields

# of a system of N phases, A (N, h, h), B (N, h, n) and C (N, q, h), which may have no state
Memory: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
# A, B, C, D, L; with other sensors A and C are stacks of one for each phase
PlantMatrices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlantParts:
    """Loop, turbulence, vibrations and noise, which fit each other."""

    hardware: LoopHardware  # with the sensor gain that the design assumes in its sensor matrix
    turbulence: tuple[ARModel, ...]  # one per mode
    vibrations: tuple[Vibration, ...]
    noise_factor: FloatArray  # (q, q): square root of the noise covariance of the loop's own sensor
    motions: Motions = ()  # of the channels that each vibration moves; of none by default

    def __post_init__(self) -> None:
        n = self.hardware.modes
        for model in self.turbulence:
            require_instance(model, ARModel, "turbulence")
        if len(self.turbulence) != n or any(m.coefficients.ndim > 1 for m in self.turbulence):
            raise DimensionError(
                f"turbulence must be one ARModel, or one per mode ({n}); got "
                f"{sum(model.count for model in self.turbulence)}."
            )
        for model in self.turbulence:
            require_loop_rate(model.frame_rate_hz, self.hardware)
        for line in self.vibrations:
            checked_direction(require_instance(line, Vibration, "each vibration"), self.hardware)
        lines = len(self.vibrations)
        motions = self.motions if any(self.motions) else ({},) * lines
        set_fields(self, motions=checked_motions(motions, self.hardware.suite, lines))

    @property
    def order(self) -> int:
        """Largest order of a turbulence model."""
        return max(model.order for model in self.turbulence)

    @property
    def sections(self) -> int:
        """Number of resonances, those of a bump each counted."""
        return sum(line.sections for line in self.vibrations)

    @property
    def size(self) -> int:
        """Number of states of the plant of the loop's own sensor."""
        blocks = self.order + held_frames(self.hardware)
        return 2 * self.sections + blocks * self.hardware.modes


def held_frames(hardware: LoopHardware) -> int:
    """Return how many frames of the total phase the state of a plant holds."""
    return max(int(np.ceil(hardware.delay_frames)), 2) - 1


def sensor_memory(hardware: LoopHardware, *, own: bool = False, ahead: int = 0) -> Memory:
    """Return the system from a signal s(k) (n,) to the readings in frame k, of s before k.

    They are those of the other wavefront sensors, as old as they are with so many more frames
    ``ahead``, after those of the loop's ``own`` sensor if it counts. An exposure ends in frame e
    with the mean of the frames since the last end; the sum of a period that has begun and the
    readings that wait are its states. Where an exposure ends within a frame, that frame counts for
    both exposures, in part.
    """
    modes, period = hardware.modes, hardware.period
    blocks = [(np.zeros((period, 0, 0)), np.zeros((period, 0, modes)), np.zeros((period, 0, 0)))]
    if own:
        blocks.append(_exposure_memory(hardware.sensor, 1.0, 1, period))
    for sensor in hardware.suite.wavefront:
        age = sensor.age_frames(hardware) + ahead
        frames = period_frames(sensor, hardware)
        blocks.append(_exposure_memory(sensor.response(modes), age, frames, period))
    A, B, C = zip(*blocks, strict=True)
    return block_diag(*A), np.concatenate(B, axis=1), block_diag(*C)


def _exposure_memory(response: FloatArray, age_frames: float, frames: int, period: int) -> Memory:
    """Return the memory of one sensor (q, n), with states [sum, newest reading, older...].

    The oldest frame that a reading averages has an age, and readings are in frames 0, frames, ...
    """
    modes, age = response.shape[1], int(np.floor(age_frames + WHOLE))
    late = age_frames - age  # by which the exposure ends before its last frame does
    late = 0.0 if late < WHOLE else late
    held = 1 + (age - frames) // frames  # readings that wait when one is taken
    sums = int(frames > 1 or late > 0)  # states before the readings
    size = sums + held
    ends = (frames - age - 1) % frames  # frame of the period in which an exposure ends
    A, B = np.zeros((period, size, size)), np.zeros((period, size))
    for t in range(period):
        if t % frames == ends:
            B[t, sums] = (1 - late) / frames
            A[t, sums + 1 :, sums:-1] = np.eye(held - 1)
            if sums:
                A[t, 1, 0], B[t, 0] = 1.0, late / frames
        else:
            A[t], B[t, :sums] = np.eye(size), 1 / frames
    C = np.zeros((len(response), size * modes))
    C[:, -modes:] = response
    identity = np.eye(modes)
    stack = np.broadcast_to(C, (period, *C.shape))
    return np.asarray(np.kron(A, identity)), np.asarray(np.kron(B[:, :, None], identity)), stack


def known_states(hardware: LoopHardware) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C, D of what commands make: the mirror's states, and corrections that wait.

    They are stacks (N, ...). In frame k they are driven by u(k-1), so that the corrections
    remembered are those before k - 1, and the reading adds the one of k - 1. The measurements are
    those of all sensors.
    """
    A_w, B_w, C_w = sensor_memory(hardware)
    mirror = hardware.mirror_system.whole
    A_m, B_m, C_m = mirror.repeated(hardware.n_commands)
    position, direct = hardware.influence @ C_m, mirror.D * hardware.influence
    (period, w, _), v = A_w.shape, len(A_m)
    last = np.roll(np.arange(period), 1)  # the phase before
    A, B = np.zeros((period, v + w, v + w)), np.zeros((period, v + w, hardware.n_commands))
    A[:, :v, :v], B[:, :v] = A_m, B_m
    A[:, v:, v:], A[:, v:, :v] = A_w[last], B_w[last] @ position
    B[:, v:] = B_w[last] @ direct
    q0, q1 = hardware.n_measurements, C_w.shape[1]
    C = np.zeros((period, hardware.n_readings, v + w))
    D = np.zeros((period, hardware.n_readings, hardware.n_commands))
    C[:, :q0, :v], C[:, q0 : q0 + q1] = -hardware.sensor @ position, -C_w @ A[:, v:]
    D[:, :q0], D[:, q0 : q0 + q1] = -hardware.sensor @ direct, -C_w @ B[:, v:]
    return A, B, C, D


def plant_matrices(parts: PlantParts) -> PlantMatrices:
    """Return the matrices of a plant from its parts."""
    alone = _own_matrices(parts)
    return _with_other_sensors(alone, parts) if parts.hardware.suite.sensors else alone


def _own_matrices(parts: PlantParts) -> PlantMatrices:
    """Return the matrices of the plant of the loop's own sensor."""
    hardware, p, n = parts.hardware, len(parts.vibrations), parts.hardware.modes
    lines, feeds, drives = _section_states(parts)
    air = ARModel.stack(parts.turbulence).coefficients

    tur = 2 * parts.sections  # where parts of the state begin, and end
    tot, size = tur + air.size, parts.size
    total = np.zeros((n, size))
    total[:, :p] = np.array([line.direction for line in parts.vibrations]).reshape(p, n).T
    total[:, tur : tur + n] = np.eye(n)
    A = np.zeros((size, size))
    A[:tur, :tur], A[tur:tot, tur:tot] = _companion(lines), _companion(air)
    A[: parts.sections, : parts.sections] += feeds
    A[tot : tot + n], A[tot + n :, tot : size - n] = total, np.eye(size - tot - n)

    q = hardware.n_measurements
    B = np.zeros((size, p + n + q))
    B[: parts.sections, :p] = drives
    B[tur : tur + n, p : p + n] = np.diag([m.driving_rms_nm for m in parts.turbulence])
    C = np.zeros((q, size))
    C[:, size - n :] = hardware.sensor
    late = held_frames(hardware) + 1 - hardware.delay_frames  # weight of the frame before
    D, L = np.hstack([np.zeros((q, p + n)), parts.noise_factor]), (1 - late) * total
    return A, B, C, D, L + late * np.eye(n, size, k=tot)


def _section_states(parts: PlantParts) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return AR2 coefficients of all sections, (s, 2), what feeds each, (s, s), and their drives.

    The first p sections are the vibrations themselves. Before that of a bump stand those that
    feed it, each of the bump's rms: the first of them has the white noise, (s, p).
    """
    rate, p = parts.hardware.frame_rate_hz, len(parts.vibrations)
    lines, place = np.zeros((parts.sections, 2)), p
    feeds, drives = np.zeros((parts.sections, parts.sections)), np.zeros((parts.sections, p))
    for j, line in enumerate(parts.vibrations):
        if line.sections == 1:
            model = line.ar_model(rate)
            lines[j], drives[j, j] = model.coefficients, model.driving_rms_nm
            continue
        angle = 2 * np.pi * line.frequency_hz / rate
        chain = [*range(place, place + line.sections - 1), j]
        place += line.sections - 1
        deviations = section_drives(angle, line.damping, line.sections)
        lines[chain] = coefficient_rows(np.array(angle), np.array(line.damping))
        feeds[chain[1:], chain[:-1]] = deviations[1:] / deviations[:-1]
        drives[chain[0], j] = line.rms_nm * deviations[0]
    return lines, feeds, drives


def _companion(coefficients: FloatArray) -> FloatArray:
    """State matrix (k order, k order) of k AR processes with coefficients (k, order)."""
    k, order = coefficients.shape
    A = np.eye(k * order, k=-k)
    A[:k] = np.hstack([np.diag(lag) for lag in coefficients.T])
    return A


def _with_other_sensors(alone: PlantMatrices, parts: PlantParts) -> PlantMatrices:
    """Add to the plant of the own sensor what the others remember and read."""
    hardware, period = parts.hardware, parts.hardware.period
    # the plant's state is that of the frame in which u(k) acts: older readings by so many frames
    ahead = held_frames(hardware) - 1
    A_w, B_w, C_w = sensor_memory(hardware, ahead=ahead)
    A_s, B_s, C_s, to_own = _shaken_plant(alone, parts, ahead)
    newest = 2 * parts.sections + parts.order * hardware.modes
    own_A, _, own_C, _, own_L = alone
    total = own_A[newest : newest + hardware.modes]  # total(k) from x(k): it is held in x(k+1)
    n, w = len(B_s), A_w.shape[1]
    to_own = np.hstack([to_own, np.zeros((len(to_own), w))])
    A = block_diag(A_s, A_w)
    A[:, n:] += B_w @ (total @ to_own)
    q0, q1, q2 = len(own_C), C_w.shape[1], len(C_s)
    C = np.zeros((period, q0 + q1 + q2, n + w))
    C[:, :q0], C[:, q0 : q0 + q1, n:], C[:, q0 + q1 :, :n] = own_C @ to_own, C_w, C_s
    noise = hardware.suite.noise_factor(parts.noise_factor, hardware.modes)
    B = np.pad(B_s, ((0, w), (0, len(noise))))
    D = np.pad(noise, ((0, 0), (B_s.shape[1], 0)))
    return A, B, C, D, own_L @ to_own


def _shaken_plant(
    alone: PlantMatrices, parts: PlantParts, ahead: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Put the oscillators that accelerometers see in the place of their vibrations.

    Return A (N, n, n), B (n, w) without the noise of sensors, C (c, n) of the channels, and the map
    (n0, n) to the states of the loop's own plant, older samples left out.
    """
    hardware, motions, suite = parts.hardware, parts.motions, parts.hardware.suite
    (own_A, own_B, own_C, _, _), period = alone, hardware.period
    seen = [j for j, motion in enumerate(motions) if motion]
    accelerometers = suite.accelerometers
    stacks = [
        seen_vibration(line, motion, accelerometers, hardware, ahead=ahead).stacks()
        for line, motion in zip(parts.vibrations, motions, strict=True)
        if motion
    ]
    kept = np.delete(np.arange(len(own_A)), [*seen, *(parts.sections + j for j in seen)])
    drives = np.delete(np.arange(own_B.shape[1] - len(own_C)), seen)
    transitions = (A[np.arange(period) % len(A)] for A, *_ in stacks)
    A = block_diag(np.zeros((period, len(kept), len(kept))), *transitions)
    B = block_diag(own_B[np.ix_(kept, drives)], *(B[0] for _, B, *_ in stacks))
    to_own, C = np.zeros((len(own_A), len(B))), np.zeros((len(suite.channels), len(B)))
    to_own[kept, : len(kept)] = np.eye(len(kept))
    row = len(kept)
    for j, (_, _, outputs, _) in zip(seen, stacks, strict=True):
        states = slice(row, row + outputs.shape[-1])
        to_own[j, states] = outputs[0, 0]
        channels = [i for i, name in enumerate(suite.channels) if name in motions[j]]
        C[channels, states] = outputs[0, 1:]
        row = states.stop
    A[:, : len(kept)] = own_A[kept] @ to_own
    return A, B, C, to_own
