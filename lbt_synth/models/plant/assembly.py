"""The matrices of a plant from its parts (Agapito et al. 2008, eqs. 5-7, and other sensors).

Without other sensors the state is the paper's. With some it is that without the vibrations that
accelerometers see, then that of these (:class:`SeenVibration`), then the sums and waiting readings
of the other wavefront sensors. The measurements are those of the loop's own sensor, of the other
wavefront sensors, and of the channels, in this order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lbt_synth.models.ar_model import padded_coefficients
from lbt_synth.models.plant.parts import PlantParts, held_frames
from lbt_synth.models.plant.readings import memory, other_exposures
from lbt_synth.models.plant.seen_vibration import seen_vibration
from lbt_synth.models.resonance_spectrum import coefficients, section_drives
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlantMatrices:
    """Matrices of a plant; with other sensors A and C are stacks of one for each phase."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    L: FloatArray


def plant_matrices(parts: PlantParts) -> PlantMatrices:
    """Return the matrices of a plant from its parts."""
    own = _own_matrices(parts)
    return _with_other_sensors(own, parts) if parts.hardware.suite.sensors else own


def _own_matrices(parts: PlantParts) -> PlantMatrices:
    """Return the matrices of the plant of the loop's own sensor."""
    hardware, p, n = parts.hardware, len(parts.vibrations), parts.hardware.modes
    lines, feeds, drives = _section_states(parts)
    air = padded_coefficients(parts.turbulence)

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
    return PlantMatrices(
        A=A,
        B=B,
        C=C,
        D=np.hstack([np.zeros((q, p + n)), parts.noise_factor]),
        L=(1 - late) * total + late * np.eye(n, size, k=tot),
    )


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
        lines[chain] = coefficients(angle, line.damping)[:2]
        feeds[chain[1:], chain[:-1]] = deviations[1:] / deviations[:-1]
        drives[chain[0], j] = line.rms_nm * deviations[0]
    return lines, feeds, drives


def _companion(coefficients: FloatArray) -> FloatArray:
    """State matrix (k order, k order) of k AR processes with coefficients (k, order)."""
    k, order = coefficients.shape
    A = np.eye(k * order, k=-k)
    A[:k] = np.hstack([np.diag(lag) for lag in coefficients.T])
    return A


def _with_other_sensors(own: PlantMatrices, parts: PlantParts) -> PlantMatrices:
    """Add to the plant of the own sensor what the others remember and read."""
    hardware, period = parts.hardware, parts.hardware.period
    # the plant's state is that of the frame in which u(k) acts: older readings by so many frames
    ahead = held_frames(hardware) - 1
    late = [
        replace(exposure, age_frames=exposure.age_frames + ahead)
        for exposure in other_exposures(hardware)
    ]
    waiting = memory(late, hardware.modes, period)
    shaken = _shaken_plant(own, parts, ahead)
    newest = 2 * parts.sections + parts.order * hardware.modes
    total = own.A[newest : newest + hardware.modes]  # total(k) from x(k): it is held in x(k+1)
    n, w = shaken.A.shape[1], waiting.n_states
    to_own = np.hstack([shaken.to_own, np.zeros((len(own.A), w))])
    A = np.zeros((period, n + w, n + w))
    A[:, :n, :n], A[:, n:, n:] = shaken.A, waiting.A
    A[:, n:] += waiting.B @ (total @ to_own)
    q0, q1, q2 = len(own.C), waiting.C.shape[1], len(shaken.C)
    C = np.zeros((period, q0 + q1 + q2, n + w))
    C[:, :q0], C[:, q0 : q0 + q1, n:], C[:, q0 + q1 :, :n] = own.C @ to_own, waiting.C, shaken.C
    noise = hardware.suite.noise_factor(parts.noise_factor, hardware.modes)
    drives = shaken.B.shape[1]
    B, D = np.zeros((n + w, drives + len(noise))), np.zeros((len(noise), drives + len(noise)))
    B[:n, :drives], D[:, drives:] = shaken.B, noise
    return PlantMatrices(A=A, B=B, C=C, D=D, L=own.L @ to_own)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ShakenPlant:
    """A plant whose vibrations are those that accelerometers see, where they see them."""

    A: FloatArray  # (N, n, n)
    B: FloatArray  # (n, w): from white noise, without that of sensors
    C: FloatArray  # (c, n): what channels read
    to_own: FloatArray  # (n0, n): to the states of the loop's own plant, older samples left out


def _shaken_plant(own: PlantMatrices, parts: PlantParts, ahead: int) -> _ShakenPlant:
    """Put the oscillators that accelerometers see in the place of their vibrations."""
    hardware, motions, suite = parts.hardware, parts.motions, parts.hardware.suite
    q0, period = len(own.C), hardware.period
    seen = [j for j, motion in enumerate(motions) if motion]
    lines = [
        seen_vibration(parts.vibrations[j], motions[j], suite.accelerometers, hardware, ahead=ahead)
        for j in seen
    ]
    kept = np.delete(np.arange(len(own.A)), [*seen, *(parts.sections + j for j in seen)])
    drives = np.delete(np.arange(own.B.shape[1] - q0), seen)
    size, width = len(kept) + sum(s.n_states for s in lines), len(drives)
    to_own, C = np.zeros((len(own.A), size)), np.zeros((len(suite.channels), size))
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
