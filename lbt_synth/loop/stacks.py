"""Stacks of closed loops at many sensor gains and delays, by independent part such as tip or tilt.

Between two whole delays a settled mirror shows the commands of two frames within an exposure, so
that every matrix of the loop is affine in the fraction, as it is in the sensor gain.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from lbt_synth.linear.matrix_functions import component_labels
from lbt_synth.linear.state_space import stacked_response
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, last_frame, loop_matrices
from lbt_synth.loop.evaluator import STILL, Evaluator, block_diagonal
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import (
    Hold,
    Response,
    mirror_system,
    tapped_mirror,
)
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

# some modes of a loop, (c, n) of c equal parts, and their measurements, (c, q); the matrices of
# their controllers; the sensor (q, n) and the influence (n, m)
Part: TypeAlias = tuple[IntArray, IntArray, tuple[FloatArray, ...], FloatArray, FloatArray]
_ROUNDING = 1e-13  # smaller entries, relative to the largest of their matrix, count as zero


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopStack:
    """k loops of some modes, from ``[phi_tot (n), noise (q)]`` to ``[phi_res (n), u (m), y (q)]``.

    Parts of a loop that are equal, c of them, have one stack. The mirrors are ``(1 - fraction)
    first + fraction second``.
    """

    modes: IntArray  # indices in the whole loop, (c, n)
    measurements: IntArray  # (c, q)
    controllers: tuple[FloatArray, ...]  # A, B, C, D in textbook form, (1 or k, ., .) each
    sensor: FloatArray  # (q, n)
    influence: FloatArray  # (n, m)
    mirrors: tuple[Response, Response]  # first and second, with the same states
    hold: Hold | None  # where a mirror with dynamics is within a frame; a settled one stays
    start: FloatArray  # of the hold of u(k) after the begin of exposure k [frames], (k,)
    loops: IntArray  # which loops, (k,)
    fraction: FloatArray  # (k,)
    sensor_gains: FloatArray  # (k,)
    A: FloatArray  # (k, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray
    poles: ComplexArray  # (k, s)

    def take(self, which: IntArray) -> LoopStack:
        """Return some of the loops."""
        names = ["loops", "start", "fraction", "sensor_gains", *"ABCD", "poles"]
        values = {name: getattr(self, name)[which] for name in names}
        controllers = _of_loops(self.controllers, which)
        return replace(self, controllers=controllers, **values)

    @property
    def holds_are_frames(self) -> bool:
        """Whether each command holds for one whole exposure in all of these loops."""
        return self.hold is None and not np.any(self.fraction)

    def image_powers(self, f: FloatArray) -> FloatArray:
        """Powers (f, k) that a unit phase of all moments leaves, for one mode."""
        hold, z = self.hold or STILL, np.exp(2j * np.pi * f)
        path, rejection, denominator = self._parts(z)
        mirrored = np.sinc(f)[:, None] * (rejection * path)[0, 0]
        mirrored = mirrored * (self.sensor_gains / denominator)
        positions, means = self._positions(z), hold.phase_means(f)
        late = np.exp(-2j * np.pi * f[:, None] * (self.start - hold.start - 0.5))
        crossed = (positions * means.conj() @ hold.weights)[:, None] * late
        squares = (np.abs(positions) ** 2 @ hold.weights)[:, None]
        return np.asarray(1 - 2 * np.real(crossed * mirrored) + squares * np.abs(mirrored) ** 2)

    def responses(self, f: FloatArray, share: FloatArray, *, held: bool) -> Iterator[ComplexArray]:
        """Yield what phases leave of the means over frames, which are a share (f,) of them.

        Where commands are held it is the mirror's mean position, in each piece of the hold. The
        frequencies are in cycles per frame, the responses (n, n, f, k).
        """
        path, rejection, denominator = self._parts(np.exp(2j * np.pi * f))
        if not held:
            yield rejection * (share[:, None] / denominator)
            return
        closed = rejection * (self.sensor_gains / denominator)
        for position in self._positions(np.exp(2j * np.pi * f)).T:
            entering = (share * position)[:, None] * path
            single = len(path) == 1
            yield closed * entering if single else np.einsum("nm...,mr...->nr...", closed, entering)

    def rows(self, *, held: bool) -> tuple[FloatArray, FloatArray]:
        """Return C (k, g, n, s) and D (k, g, n, n + q) of what :meth:`responses` are of."""
        n, m = self.influence.shape
        if not held:
            return self.C[:, None, :n], self.D[:, None, :n]
        first = self.controllers[0].shape[-1]  # the states of the mirror follow
        commands = self.C[:, n : n + m], self.D[:, n : n + m]
        return (self.hold or STILL).positions(self.influence, commands, first)

    def _parts(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return the path without the mirror, rejection and denominator, (n, n, f, k)."""
        controller = np.moveaxis(stacked_response(self.controllers, z), (2, 3), (0, 1))
        path = np.einsum("nm,mq...,qr->nr...", self.influence, controller, self.sensor)
        path = path / z[:, None]
        first, second = (_mirror_response(mirror, z)[:, None] for mirror in self.mirrors)
        loop = self.sensor_gains * (first * path)
        if np.any(self.fraction):
            loop += (self.sensor_gains * self.fraction) * ((second - first) * path)
        loop += np.eye(len(path))[:, :, None, None]
        return (path, *_inverses(loop))

    def _positions(self, z: ComplexArray) -> ComplexArray:
        """Return the mirror's mean position in each piece of a hold for unit commands, (f, g)."""
        hold, first = self.hold or STILL, self.mirrors[0]
        core = hold.C.shape[1]  # the first states of the mirror
        parts = (first.A[:core, :core], first.B[:core, None], hold.C, hold.D[:, None])
        return stacked_response(tuple(part[None] for part in parts), z)[:, 0, :, 0]


def stack_evaluator(
    members: Sequence[tuple[LoopStack, IntArray]], hardware: LoopHardware, *, in_image: bool
) -> Evaluator:
    """Return the evaluator of loops, of independent parts of them with the modes of each."""
    first, _ = members[0]
    held = in_image and not first.holds_are_frames
    sizes = [len(stack.influence) for stack, _ in members]
    rows = [stack.rows(held=held) for stack, _ in members]
    C = block_diagonal([one for one, _ in rows])
    D = _join_inputs([one for _, one in rows], sizes)
    poles = np.concatenate([stack.poles.ravel() for stack, _ in members])

    def response(f: FloatArray, share: FloatArray, entry: FloatArray) -> Iterator[ComplexArray]:
        parts = (stack.responses(f, share, held=held) for stack, _ in members)
        for pieces in zip(*parts, strict=True):
            yield _entered(pieces, entry)

    return Evaluator(
        A=block_diagonal([stack.A for stack, _ in members]),
        B=_join_inputs([stack.B for stack, _ in members], sizes),
        C=C.reshape(len(C), -1, C.shape[-1]),
        D=D.reshape(len(D), -1, D.shape[-1]),
        modes=sum(sizes),
        frame_rate_hz=hardware.frame_rate_hz,
        roots=poles,
        hold=(first.hold or STILL) if held else None,
        start=first.start,
        in_image=in_image,
        phases=1,
        response=response,
    )


def _join_inputs(blocks: Sequence[FloatArray], sizes: Sequence[int]) -> FloatArray:
    """Return matrices of parts over [phases, noise] as one of all phases, then all noise."""
    halves = [np.split(block, [n], axis=-1) for block, n in zip(blocks, sizes, strict=True)]
    joined = [block_diagonal([half[i] for half in halves]) for i in (0, 1)]
    return np.concatenate(joined, axis=-1)


def _entered(pieces: tuple[ComplexArray, ...], entry: FloatArray) -> ComplexArray:
    """Return responses of parts (n, n, f, k) to phases that enter them, (k or 1, n, w)."""
    if len(pieces) == 1 and np.array_equal(entry, np.eye(entry.shape[1])[None]):
        return pieces[0]
    ends, out = np.cumsum([len(piece) for piece in pieces]), []
    for piece, own in zip(pieces, np.split(entry, ends[:-1], axis=1), strict=True):
        columns = (
            sum(piece[:, m] * own[:, m, w] for m in range(len(piece)))
            for w in range(entry.shape[2])
        )
        out.append(np.stack(list(columns), axis=1))
    return np.concatenate(out)


def close_loops(
    matrices: tuple[FloatArray, ...],
    hardware: LoopHardware,
    sensor_gains: FloatArray,
    delay_frames: FloatArray,
) -> tuple[BoolArray, list[list[LoopStack]]]:
    """Close loops of controllers (1 or p, ., .); return stability, and stacks by delay."""
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
) -> tuple[list[Part], list[FloatArray]]:
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
    parts: dict[tuple[bytes, ...], Part] = {}
    rest = []
    for i in range(np.max(label) + 1):
        states, inputs, commands, modes = (np.flatnonzero(label[k] == i) for k in (x, y, u, r))
        entry, leaving = states[:, None], commands[:, None]
        own = A[:, entry, states], B[:, entry, inputs], C[:, leaving, states], D[:, leaving, inputs]
        path = sensor[np.ix_(inputs, modes)], influence[np.ix_(modes, commands)]
        key = tuple(matrix.tobytes() for matrix in (*own, *path))
        if modes.size and key in parts:
            modes = np.vstack([parts[key][0], modes])
            inputs = np.vstack([parts[key][1], inputs])
        if modes.size:
            parts[key] = np.atleast_2d(modes), np.atleast_2d(inputs), own, *path
        elif states.size:
            rest.append(own[0])
    return list(parts.values()), rest


def _nonzero_entries(entries: FloatArray) -> BoolArray:
    """Which entries are more than rounding in any of the matrices (N, ., .)."""
    sizes = np.abs(entries)
    largest = np.max(sizes, axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray(np.any(sizes > _ROUNDING * largest, axis=0))


def _close_part(
    part: Part,
    rows: IntArray,
    fraction: FloatArray,
    gains: FloatArray,
    mirrors: tuple[Response, Response],
    hold: Hold | None,
    start: FloatArray,
) -> LoopStack:
    """Close the loops of a part at one whole delay."""
    modes, measurements, matrices, sensor, influence = part
    controllers, readings = _of_loops(matrices, rows), last_frame(sensor)
    ends = [
        loop_matrices(*controllers, mirror=mirror, readings=readings, influence=influence)
        for mirror in mirrors
    ]
    share, gain = fraction[:, None, None], gains[:, None, None]
    A0, A1, B, C0, C1, D = (one + share * (two - one) for one, two in zip(*ends, strict=True))
    A = A0 + gain * A1
    return LoopStack(
        modes=modes,
        measurements=measurements,
        controllers=controllers,
        sensor=sensor,
        influence=influence,
        mirrors=mirrors,
        hold=hold,
        start=start,
        loops=rows,
        fraction=fraction,
        sensor_gains=gains,
        A=A,
        B=B,
        C=C0 + gain * C1,
        D=D,
        poles=np.linalg.eigvals(A).astype(np.complex128),
    )


def _of_loops(controllers: tuple[FloatArray, ...], rows: IntArray) -> tuple[FloatArray, ...]:
    """Return the controllers of some loops, or the one that serves all."""
    one = len(controllers[0]) == 1
    return controllers if one else tuple(matrix[rows] for matrix in controllers)


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
