"""Stacks of closed loops at many sensor gains and delays, by independent part such as tip or tilt.

Between two whole delays a settled mirror shows the commands of two frames within an exposure, so
that every matrix of the loop is affine in the fraction, as it is in the sensor gain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from lbt_synth.linear.matrix_functions import component_labels
from lbt_synth.linear.state_space import stacked_response
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, loop_matrices
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import (
    Hold,
    Response,
    mirror_system,
    tapped_mirror,
)
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

_ROUNDING = 1e-13  # smaller entries, relative to the largest of their matrix, count as zero
_FRACTIONS = 12  # of a delay, between which a smooth function is interpolated to 1e-10
_CANCELS = 1e-5  # of a square that is a sum of terms of the order of 1
_STILL = Hold(start=0.0, edges=np.array([0.0, 1.0]), C=np.zeros((1, 0)), D=np.ones(1))


@dataclass(frozen=True, slots=True, eq=False)
class LoopPart:
    """Some modes of a loop, and all that depends on them; c of them that are equal are one part.

    The controllers ``A, B, C, D`` are in textbook form, (N, ., .) each: one for all loops, or one
    per loop.
    """

    modes: IntArray  # indices in the whole loop, (c, n)
    measurements: IntArray  # (c, q)
    matrices: tuple[FloatArray, ...]  # of the controllers
    sensor: FloatArray  # (q, n)
    influence: FloatArray  # (n, m)

    def controllers(self, rows: IntArray) -> tuple[FloatArray, ...]:
        """Return the controllers ``A, B, C, D`` of some loops, or the one that serves all."""
        one = len(self.matrices[0]) == 1
        return self.matrices if one else tuple(matrix[rows] for matrix in self.matrices)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopStack:
    """k loops of one part, from ``[phi_tot (n), noise (q)]`` to ``phi_res (n)``.

    Their mirrors are ``(1 - fraction) first + fraction second``.
    """

    part: LoopPart
    mirrors: tuple[Response, Response]  # first and second, with the same states
    hold: Hold | None  # where a mirror with dynamics is within a frame; a settled one stays
    start: FloatArray  # of the hold of u(k) after the begin of exposure k [frames], (k,)
    rows: IntArray  # which loops, (k,)
    fraction: FloatArray  # (k,)
    sensor_gains: FloatArray  # (k,)
    A: FloatArray  # (k, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray
    command_C: FloatArray  # (k, m, s): from the states to the commands
    command_D: FloatArray
    poles: ComplexArray  # (k, s)

    def take(self, which: IntArray) -> LoopStack:
        """Return some of the loops."""
        names = ["rows", "start", "fraction", "sensor_gains", *"ABCD", "poles"]
        names += ["command_C", "command_D"]
        return replace(self, **{name: getattr(self, name)[which] for name in names})

    @property
    def holds_are_frames(self) -> bool:
        """Whether each command holds for one whole exposure in all of these loops."""
        return self.hold is None and not np.any(self.fraction)

    @property
    def is_single(self) -> bool:
        """Whether these are loops of one mode, measurement and command with a settled mirror."""
        sizes = *self.part.sensor.shape, self.part.influence.shape[1]
        return self.hold is None and sizes == (1, 1, 1)

    def single_powers(self, z: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Powers (f, k) of what a hold leaves of a unit mean over frames, and of unit noise.

        They are those of :meth:`piece_responses` for loops that are single, in fewer operations. A
        hold leaves ``(1 + g w) / (1 + g L)`` of the mean, g the gain, L the open loop at a gain of
        1, and w what L through the two frames of the hold is beyond L at its arrival.
        """
        part, gain, late = self.part, self.sensor_gains, self.fraction
        command = part.influence[0, 0] * stacked_response(part.controllers(self.rows), z)[..., 0, 0]
        measured = part.sensor[0, 0] * command / z[:, None]
        first, second = (_mirror_response(one, z)[:, None] * measured for one in self.mirrors)
        arrival = measured * z[:, None] ** -(self.start[0] - late[0])
        power = command.real**2 + command.imag**2
        squares = _shared_squares if command.shape[1] == 1 else _squares
        left, size = squares((first, second - first, arrival, np.angle(z)[:, None]), gain, late)
        return np.divide(left, size, out=left), np.divide(power, size, out=size)

    def image_powers(self, z: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Powers (f, k) that a unit phase of all moments and unit noise leave, for one mode."""
        commands, positions, means, late = self._over_holds(z)
        command, weights = commands[0, 0], (self.hold or _STILL).weights
        mirrored = command * self._turn(z) * self.part.sensor[0, 0]
        squares = (np.abs(positions) ** 2 @ weights)[:, None]
        crossed = (positions * means.conj() @ weights)[:, None] * late.conj()
        of_phase = 1 - 2 * np.real(crossed * mirrored) + squares * np.abs(mirrored) ** 2
        return of_phase, squares * np.abs(command) ** 2

    def responses(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Rejection (n, n, f, k) at f points and negative response to noise (n, q, f, k).

        Both lack a common denominator; the inverse of its square (f, k) is returned, too.
        """
        unit, path, rejection, denominator = self._parts(z)
        if len(unit) > 1:
            path = np.asarray(sum(rejection[:, j, None] * path[j] for j in range(len(unit))))
        scale = 1 / (denominator.real**2 + denominator.imag**2)
        return rejection, path, scale

    def piece_responses(
        self, z: ComplexArray
    ) -> tuple[Iterator[tuple[float, ComplexArray, ComplexArray]], FloatArray]:
        """Residual in each piece of a hold, at f points of the upper half of the unit circle.

        Yield the length of each piece [frames], and the responses to a phase of all moments (n, n,
        f, k) and to noise (n, q, f, k). Return also the part of the phase's power that moves within
        the pieces, (f, k).
        """
        commands, positions, means, late = self._over_holds(z)
        n, hold = len(commands), self.hold or _STILL
        of_phase = np.einsum("nq...,qm->nm...", commands, self.part.sensor) * self._turn(z)
        rest = 1 - np.abs(means) ** 2 @ hold.weights

        def pieces() -> Iterator[tuple[float, ComplexArray, ComplexArray]]:
            for g, weight in enumerate(hold.weights):
                position = positions[:, g, None]
                # as seen from the middle of the frame, where the mean has its phase
                phase = (means[:, g, None] * late) * np.eye(n)[:, :, None, None]
                yield float(weight), phase - position * of_phase, -position * commands

        return pieces(), np.broadcast_to(rest[:, None], late.shape)

    def _over_holds(
        self, z: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """Return commands (n, q, f, k) for unit noise, and mirror and phase in pieces of a hold.

        Those are (f, g) each; the hold begins late by a factor (f, k).
        """
        unit, _, rejection, denominator = self._parts(z)
        commands = sum(rejection[:, j, None] * unit[j] for j in range(len(unit))) / denominator
        f, hold = np.angle(z) / (2 * np.pi), self.hold or _STILL
        core = hold.C.shape[1]  # the first states of the mirror
        A, B = self.mirrors[0].A[:core, :core], self.mirrors[0].B[:core, None]
        parts = (A, B, hold.C, hold.D[:, None])
        positions = stacked_response(tuple(part[None] for part in parts), z)[:, 0, :, 0]
        late = np.exp(2j * np.pi * f[:, None] * (self.start - hold.start - 0.5))
        return np.asarray(commands), positions, hold.phase_means(f), late

    def _turn(self, z: ComplexArray) -> ComplexArray:
        """Return what a phase of all moments is in a measurement of one frame later, (f, k)."""
        return np.sinc(np.angle(z) / (2 * np.pi))[:, None] * self.sensor_gains / z[:, None]

    def _parts(
        self, z: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """Return ``N K``, ``N K`` through the mirror, and the rejection over its denominator."""
        part = self.part
        controller = np.moveaxis(stacked_response(part.controllers(self.rows), z), (2, 3), (0, 1))
        unit = np.einsum("nm,mq...->nq...", part.influence, controller)
        path, turn = (
            unit * _mirror_response(self.mirrors[0], z)[:, None],
            self.sensor_gains / z[:, None],
        )
        if np.any(self.fraction):
            second = unit * _mirror_response(self.mirrors[1], z)[:, None]
            path = path + self.fraction * (second - path)
        sensor, modes = part.sensor[..., None, None], range(len(part.influence))
        loop = np.eye(len(modes), dtype=np.complex128)[:, :, None, None]
        for j in range(path.shape[1]):
            loop = loop + path[:, j, None] * (sensor[j] * turn)
        return (unit, path, *_inverses(loop))

    def rejections(self, turn: FloatArray) -> ComplexArray:
        """Rejection (k, n, n) of each loop at its own frequency [radians per frame]."""
        n = self.C.shape[1]
        pencil = np.exp(1j * turn)[:, None, None] * np.eye(self.A.shape[1]) - self.A
        states = np.linalg.solve(pencil, self.B[..., :n].astype(np.complex128))
        return np.asarray(self.C @ states + self.D[..., :n])

    def pieces_at(self, turn: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Residual (k, g, n, n) in pieces of a hold, for each loop at its own frequency.

        Return also their lengths [frames], (g,), and the power that moves within them, (k,).
        """
        n, f, hold = self.C.shape[1], turn / (2 * np.pi), self.hold or _STILL
        commands, first = (self.command_C, self.command_D), self.part.matrices[0].shape[-1]
        C, D = hold.positions(self.part.influence, commands, first)
        pencil = np.exp(1j * turn)[:, None, None] * np.eye(self.A.shape[1]) - self.A
        states = np.linalg.solve(pencil, self.B[..., :n].astype(np.complex128))
        positions = (C @ states[:, None] + D[..., :n]) * np.sinc(f)[:, None, None, None]
        late = np.exp(2j * np.pi * f * (self.start - hold.start - 0.5))
        means = hold.phase_means(f) * late[:, None]
        phase = means[..., None, None] * np.eye(n)
        return phase - positions, hold.weights, 1 - np.abs(means) ** 2 @ hold.weights


def close_loops(
    matrices: tuple[FloatArray, ...],
    hardware: LoopHardware,
    sensor_gains: FloatArray,
    delay_frames: FloatArray,
) -> tuple[BoolArray, list[list[LoopStack]]]:
    """Close the loops of controllers ``A, B, C, D`` in textbook form, (1 or p, ., .) each.

    Return which of the p loops are stable, and by whole delay the stacks of all parts.
    """
    stable = np.ones(sensor_gains.size, dtype=np.bool_)
    parts, rest = split_into_parts(matrices, hardware)
    for A in rest:
        stable &= _are_stable(np.linalg.eigvals(A).astype(np.complex128))
    groups = []
    for rows, fraction, mirrors, hold in _mirrors_by_delay(hardware, delay_frames):
        gains, start = sensor_gains[rows], delay_frames[rows] - 1
        stacks = [_close_part(part, rows, fraction, gains, mirrors, hold, start) for part in parts]
        for stack in stacks:
            stable[rows] &= _are_stable(stack.poles)
        groups.append(stacks)
    return stable, groups


def split_into_parts(
    matrices: tuple[FloatArray, ...], hardware: LoopHardware
) -> tuple[list[LoopPart], list[FloatArray]]:
    """Split a loop into independent parts, equal ones once, and what reaches no mode."""
    A, B, C, D = matrices
    sensor, influence = hardware.sensor, hardware.influence
    s, q, m, n = A.shape[-1], B.shape[-1], C.shape[-2], hardware.modes
    x, y, u, r = np.split(np.arange(s + q + m + n), np.cumsum([s, q, m]))
    links = np.zeros((s + q + m + n, s + q + m + n), dtype=np.bool_)
    controller = (x, x, A), (x, y, B), (u, x, C), (u, y, D)
    for rows, columns, entries in (*controller, (y, r, sensor[None]), (r, u, influence[None])):
        links[np.ix_(rows, columns)] = _nonzero_entries(entries)
    label = component_labels(links)
    parts: dict[tuple[bytes, ...], LoopPart] = {}
    rest = []
    for i in range(np.max(label) + 1):
        states, inputs, commands, modes = (np.flatnonzero(label[k] == i) for k in (x, y, u, r))
        entry, leaving = states[:, None], commands[:, None]
        own = A[:, entry, states], B[:, entry, inputs], C[:, leaving, states], D[:, leaving, inputs]
        path = sensor[np.ix_(inputs, modes)], influence[np.ix_(modes, commands)]
        key = tuple(matrix.tobytes() for matrix in (*own, *path))
        if modes.size and key in parts:
            modes = np.vstack([parts[key].modes, modes])
            inputs = np.vstack([parts[key].measurements, inputs])
        if modes.size:
            parts[key] = LoopPart(np.atleast_2d(modes), np.atleast_2d(inputs), own, *path)
        elif states.size:
            rest.append(own[0])
    return list(parts.values()), rest


def _nonzero_entries(entries: FloatArray) -> BoolArray:
    """Which entries are more than rounding in any of the matrices (N, ., .)."""
    sizes = np.abs(entries)
    largest = np.max(sizes, axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray(np.any(sizes > _ROUNDING * largest, axis=0))


def _close_part(
    part: LoopPart,
    rows: IntArray,
    fraction: FloatArray,
    gains: FloatArray,
    mirrors: tuple[Response, Response],
    hold: Hold | None,
    start: FloatArray,
) -> LoopStack:
    """Close the loops of a part at one whole delay."""
    path = {"sensor": part.sensor, "influence": part.influence}
    ends = [loop_matrices(*part.controllers(rows), mirror=mirror, **path) for mirror in mirrors]
    share, gain, n = fraction[:, None, None], gains[:, None, None], len(part.influence)
    A0, A1, B, C0, C1, D = (one + share * (two - one) for one, two in zip(*ends, strict=True))
    A, C = A0 + gain * A1, C0 + gain * C1
    command = slice(n, n + part.influence.shape[1])
    return LoopStack(
        part=part,
        mirrors=mirrors,
        hold=hold,
        start=start,
        rows=rows,
        fraction=fraction,
        sensor_gains=gains,
        A=A,
        B=B,
        C=C[:, :n],
        D=D[:, :n],
        command_C=C[:, command],
        command_D=D[:, command],
        poles=np.linalg.eigvals(A).astype(np.complex128),
    )


def _mirrors_by_delay(
    hardware: LoopHardware, delay_frames: FloatArray
) -> Iterator[tuple[IntArray, FloatArray, tuple[Response, Response], Hold | None]]:
    """Yield rows, fractions and mirrors by whole delay, or by delay if the mirror has dynamics."""
    if hardware.mirror is not None:
        for delay in np.unique(delay_frames):
            mirror = mirror_system(hardware.mirror, hardware.frame_rate_hz, float(delay))
            rows = np.flatnonzero(delay_frames == delay)
            yield rows, np.zeros(rows.size), (mirror.whole, mirror.whole), mirror.hold
        return
    lead = np.floor(delay_frames - 1).astype(np.int64)
    fraction = delay_frames - 1 - lead
    for whole in np.unique(lead):
        rows = np.flatnonzero(lead == whole)
        taps = np.zeros((2, whole + (2 if np.any(fraction[rows] > 0) else 1)))
        taps[0, whole] = taps[1, -1] = 1.0
        yield rows, fraction[rows], (tapped_mirror(taps[0]), tapped_mirror(taps[1])), None


def _are_stable(poles: ComplexArray) -> BoolArray:
    return np.asarray(np.max(np.abs(poles), axis=-1) < 1 - STABILITY_MARGIN)


# of open loops: at fraction 0, how it changes to 1, at its arrival at 0, and angles of z, (f, 1)
_Paths: TypeAlias = tuple[ComplexArray, ComplexArray, ComplexArray, FloatArray]


def _path_pair(paths: _Paths, late: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Open loops L at fractions of the delay, (f, k), and what each is beyond L at its arrival."""
    first, change, arrival, turn = paths
    through = first + late * change
    return through, through - arrival * np.exp(-1j * turn * late)


def _squares(paths: _Paths, gain: FloatArray, late: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``|1 + g w|^2`` and ``|1 + g L|^2``, (f, k)."""
    through, beyond = _path_pair(paths, late)
    pair = (1 + gain * (beyond if np.any(late) else 0 * beyond), 1 + gain * through)
    left, size = (np.asarray(one.real**2 + one.imag**2) for one in pair)
    return left, size


def _shared_squares(
    paths: _Paths, gain: FloatArray, late: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return :func:`_squares` of loops of one controller, (f, 1), by products of two matrices.

    The second is a polynomial of gain and fraction; the first is one of the gain, whose
    coefficients are interpolated between fractions.
    """
    first, change, *_ = paths
    cross = 2 * (first * change.conj()).real
    terms = [np.ones_like(cross), 2 * first.real, 2 * change.real]
    terms += [np.abs(first) ** 2, cross, np.abs(change) ** 2]
    powers = [gain**0, gain, gain * late, gain**2, gain**2 * late, gain**2 * late**2]
    size = np.hstack(terms) @ np.array(powers)
    left = np.ones_like(size)
    if np.any(late):
        middle, half = (late.max() + late.min()) / 2, (late.max() - late.min()) / 2 or 1.0
        angle = np.pi * (np.arange(_FRACTIONS) + 0.5) / _FRACTIONS
        places = middle + half * np.cos(angle)
        _, beyond = _path_pair(paths, places)
        degrees = np.arange(_FRACTIONS)[:, None]
        turns = np.arccos(np.clip((late - middle) / half, -1, 1))
        weights = np.linalg.solve(np.cos(degrees * angle), np.cos(degrees * turns))
        coefficients = np.hstack([2 * beyond.real, np.abs(beyond) ** 2])
        left += coefficients @ np.vstack([weights * gain, weights * gain**2])
    poor = np.min(size, axis=0) < _CANCELS  # next to instability
    if np.any(poor):
        left[:, poor], size[:, poor] = _squares(paths, gain[poor], late[poor])
    return left, size


def _mirror_response(mirror: Response, z: ComplexArray) -> ComplexArray:
    """Response of a mirror, (f,)."""
    if mirror.is_tapped:
        return np.asarray(np.polyval([*mirror.C[::-1], mirror.D], 1 / z))
    parts = (mirror.A, mirror.B[:, None], mirror.C[None], np.array([[mirror.D]]))
    return stacked_response(tuple(part[None] for part in parts), z)[:, 0, 0, 0]


def _inverses(planes: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Inverses of many matrices (n, n, ...), as numerators and a denominator (...)."""
    if len(planes) == 1:
        return np.ones((1, 1, 1, 1), dtype=np.complex128), planes[0, 0]
    if len(planes) > 2:
        inverse = np.asarray(np.linalg.inv(np.moveaxis(planes, (0, 1), (-2, -1))), planes.dtype)
        return np.moveaxis(inverse, (-2, -1), (0, 1)), np.ones_like(planes[0, 0])
    (a, b), (c, d) = planes
    return np.array([[d, -b], [-c, a]]), np.asarray(a * d - b * c)
