"""Closed loops at many sensor gains and delays, by independent subloop such as tip and tilt.

They are arrays of state matrices. Between two whole delays a settled mirror shows the commands of
two frames within an exposure, so that every matrix of the loop is affine in the fraction, as it is
in the sensor gain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from lbt_synth.linear import StateSpace
from lbt_synth.linear.state_space import schur_response
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, loop_matrices
from lbt_synth.models import LoopHardware
from lbt_synth.models.mirror.frame_rate_system import Response, mirror_system, tapped_mirror
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

_ROUNDING = 1e-13  # smaller entries, relative to the largest of their matrix, count as zero
_SAME = 1e-11  # relative difference up to which two subloops are the same
_SHARED, _OWN = 1024, 256  # loops that share frequencies, and a controller or not
_PER_LOOP = ("rows", "fraction", "sensor_gains", "A", "B", "C", "D", "poles")


@dataclass(frozen=True, slots=True, eq=False)
class Subloop:
    """Some modes of a loop, and all that depends on them.

    The controllers ``A, B, C, D`` are in textbook form, (N, ., .) each: one for all loops, or one
    per loop.
    """

    modes: IntArray  # indices in the whole loop
    measurements: IntArray
    matrices: tuple[FloatArray, ...]  # of the controllers
    sensor: FloatArray  # (q, n)
    influence: FloatArray  # (n, m)

    @property
    def is_shared(self) -> bool:
        """Whether one controller serves all loops."""
        return len(self.matrices[0]) == 1

    @property
    def is_scalar(self) -> bool:
        """Whether it has one mode, one measurement and one command."""
        return self.sensor.shape == self.influence.shape == (1, 1)

    def unit_loop(
        self,
        controller: ComplexArray,
        first: ComplexArray,
        second: ComplexArray,
        delay: ComplexArray,
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the scalar loop at unit gain, as one part and what the fraction multiplies.

        Controller, mirrors and delay are responses at the same frequencies.
        """
        unit = self.influence[0, 0] * self.sensor[0, 0] * controller * delay
        return unit * first, unit * (second - first)

    def controllers(self, rows: IntArray) -> tuple[FloatArray, ...]:
        """Return the controllers ``A, B, C, D`` of some loops, or the one that serves all."""
        return self.matrices if self.is_shared else tuple(each[rows] for each in self.matrices)

    def equals(self, other: Subloop) -> bool:
        """Whether another subloop behaves the same, to rounding."""
        own, others = ((*x.matrices, x.sensor, x.influence) for x in (self, other))
        return all(
            one.shape == two.shape
            and np.allclose(one, two, rtol=0, atol=_SAME * np.max(np.abs(one), initial=0.0))
            for one, two in zip(own, others, strict=True)
        )


def split_into_subloops(
    matrices: tuple[FloatArray, ...], hardware: LoopHardware
) -> tuple[list[Subloop], list[FloatArray]]:
    """Split a loop into independent subloops, and the state matrices that reach no mode."""
    A, B, C, D = matrices
    sensor, influence = hardware.sensor, hardware.influence
    s, q, m, n = A.shape[-1], B.shape[-1], C.shape[-2], hardware.modes
    x, y, u, r = np.split(np.arange(s + q + m + n), np.cumsum([s, q, m]))
    links = np.zeros((s + q + m + n, s + q + m + n), dtype=np.bool_)
    controller = (x, x, A), (x, y, B), (u, x, C), (u, y, D)
    for rows, columns, entries in (*controller, (y, r, sensor[None]), (r, u, influence[None])):
        links[np.ix_(rows, columns)] = _nonzero_entries(entries)
    _, label = connected_components(links)
    subloops, rest = [], []
    for each in np.unique(label):
        own = label == each
        states, modes = np.flatnonzero(own[x]), np.flatnonzero(own[r])
        inputs, commands = np.flatnonzero(own[y]), np.flatnonzero(own[u])
        entry, leaving = states[:, None], commands[:, None]
        if modes.size == 0:
            rest.append(A[:, entry, states])
            continue
        dynamics = A[:, entry, states], B[:, entry, inputs]
        output = C[:, leaving, states], D[:, leaving, inputs]
        measure, act = sensor[np.ix_(inputs, modes)], influence[np.ix_(modes, commands)]
        subloops.append(Subloop(modes, inputs, (*dynamics, *output), measure, act))
    return subloops, rest


def _nonzero_entries(entries: FloatArray) -> BoolArray:
    """Which entries are more than rounding in any of the matrices (N, ., .)."""
    sizes = np.abs(entries)
    largest = np.max(sizes, axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray(np.any(sizes > _ROUNDING * largest, axis=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopPoints:
    """Where k loops of one subloop differ.

    Their mirrors are ``(1 - fraction) first + fraction second``.
    """

    subloop: Subloop
    first: Response  # the two mirrors have the same states
    second: Response
    rows: IntArray  # which loops, (k,)
    fraction: FloatArray  # (k,)
    sensor_gains: FloatArray  # (k,)
    poles: ComplexArray  # (k, s)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopGroup(LoopPoints):
    """k loops of one subloop, from ``[phi_tot (n), noise (q)]`` to ``phi_res (n)``."""

    A: FloatArray  # (k, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray

    def take(self, which: IntArray) -> LoopGroup:
        """Return some of the loops."""
        return replace(self, **{name: getattr(self, name)[which] for name in _PER_LOOP})

    def batches(self, stable: BoolArray) -> Iterator[LoopPoints]:
        """Yield batches of the stable loops, sorted by their distance from instability."""
        found = np.flatnonzero(stable[self.rows])
        order = found[np.argsort(_radius(self.poles[found]), kind="stable")]
        most = _SHARED if self.subloop.is_shared else _OWN
        for start in range(0, order.size, most):
            which = order[start : start + most]
            yield LoopPoints(
                subloop=self.subloop,
                first=self.first,
                second=self.second,
                rows=self.rows[which],
                fraction=self.fraction[which],
                sensor_gains=self.sensor_gains[which],
                poles=self.poles[which],
            )

    def rejections(self, turn: FloatArray) -> ComplexArray:
        """Rejection (k, n, n) of each loop at its own frequency [radians per frame]."""
        z, subloop = np.exp(1j * turn), self.subloop
        if subloop.is_shared and subloop.is_scalar:
            A, B, C, D = (part[0] for part in subloop.matrices)
            controller = system_response(A, B, C, D, z)[:, 0, 0]
            one, other = (mirror_response(end, z) for end in (self.first, self.second))
            with np.errstate(all="ignore"):  # at a pole of the controller, nothing is left
                first, second = subloop.unit_loop(controller, one, other, 1 / z)
                loop = self.sensor_gains * (first + self.fraction * second)
                return np.where(np.isfinite(loop), 1 / (1 + loop), 0)[:, None, None]
        n = self.C.shape[1]
        pencil = z[:, None, None] * np.eye(self.A.shape[1]) - self.A
        states = np.linalg.solve(pencil, self.B[..., :n].astype(np.complex128))
        return np.asarray(self.C @ states + self.D[..., :n])


def system_response(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, z: ComplexArray
) -> ComplexArray:
    """Transfer matrices (f, m, q) of one system, which may have no state."""
    if len(A) == 0:
        return np.broadcast_to(D.astype(np.complex128), (z.size, *D.shape))
    return schur_response(StateSpace(A=A, B=B, C=C, D=D).balanced(), z)


def mirror_response(mirror: Response, z: ComplexArray) -> ComplexArray:
    """Response of a mirror, (f,)."""
    if mirror.is_tapped:
        return np.asarray(np.polyval([*mirror.C[::-1], mirror.D], 1 / z))
    direct = np.array([[mirror.D]])
    return system_response(mirror.A, mirror.B[:, None], mirror.C[None], direct, z)[:, 0, 0]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClosedLoops:
    """Loops with the same sensor and mirror, at p sensor gains and delays."""

    hardware: LoopHardware
    stable: BoolArray  # (p,)
    subloops: list[list[LoopGroup]]  # the groups of each subloop, with the same rows in all

    @classmethod
    def of(
        cls,
        matrices: tuple[FloatArray, ...],
        hardware: LoopHardware,
        sensor_gains: FloatArray,
        delay_frames: FloatArray,
    ) -> ClosedLoops:
        """Close the loops of controllers ``A, B, C, D`` in textbook form, (1 or p, ., .) each."""
        stable = np.ones(sensor_gains.size, dtype=np.bool_)
        subloops, rest = split_into_subloops(matrices, hardware)
        for A in rest:
            if A.shape[-1]:
                stable &= _radius(np.linalg.eigvals(A).astype(np.complex128)) < 1 - STABILITY_MARGIN
        closed: list[list[LoopGroup]] = []
        for subloop in subloops:  # equal ones are closed only once
            known = next((groups for groups in closed if groups[0].subloop.equals(subloop)), None)
            if known is None:
                groups = list(_close_subloop(subloop, hardware, sensor_gains, delay_frames))
                for group in groups:
                    stable[group.rows] &= _radius(group.poles) < 1 - STABILITY_MARGIN
            else:
                groups = [replace(group, subloop=subloop) for group in known]
            closed.append(groups)
        return cls(hardware=hardware, stable=stable, subloops=closed)


def _close_subloop(
    subloop: Subloop, hardware: LoopHardware, sensor_gains: FloatArray, delay_frames: FloatArray
) -> Iterator[LoopGroup]:
    """Close a subloop at all sensor gains and delays, by whole delay."""
    for rows, fraction, mirrors in _mirrors_by_delay(hardware, delay_frames):
        parts = {"sensor": subloop.sensor, "influence": subloop.influence}
        ends = [loop_matrices(*subloop.controllers(rows), mirror=m, **parts) for m in mirrors]
        share, gain = fraction[:, None, None], sensor_gains[rows][:, None, None]
        A0, A1, B, C0, C1, D = (
            one if not fraction.any() or np.array_equal(one, two) else one + share * (two - one)
            for one, two in zip(*ends, strict=True)
        )
        n, A = subloop.modes.size, A0 + gain * A1
        B, D = (np.broadcast_to(m, (rows.size, *m.shape[1:])) for m in (B, D[:, :n]))
        yield LoopGroup(
            subloop=subloop,
            first=mirrors[0],
            second=mirrors[1],
            rows=rows,
            fraction=fraction,
            sensor_gains=sensor_gains[rows],
            A=A,
            B=B,
            C=(C0 + gain * C1)[:, :n],
            D=D,
            poles=np.linalg.eigvals(A).astype(np.complex128),
        )


def _mirrors_by_delay(
    hardware: LoopHardware, delay_frames: FloatArray
) -> Iterator[tuple[IntArray, FloatArray, tuple[Response, Response]]]:
    """Yield rows, fractions and mirrors by whole delay, or by delay if the mirror has dynamics."""
    if hardware.mirror is not None:
        for delay in np.unique(delay_frames):
            mirror = mirror_system(hardware.mirror, hardware.frame_rate_hz, float(delay)).whole
            rows = np.flatnonzero(delay_frames == delay)
            yield rows, np.zeros(rows.size), (mirror, mirror)
        return
    lead = np.floor(delay_frames - 1).astype(np.int64)
    fraction = delay_frames - 1 - lead
    for whole in np.unique(lead):
        rows = np.flatnonzero(lead == whole)
        taps = np.zeros((2, whole + (2 if np.any(fraction[rows] > 0) else 1)))
        taps[0, whole] = taps[1, -1] = 1.0
        yield rows, fraction[rows], (tapped_mirror(taps[0]), tapped_mirror(taps[1]))


def _radius(poles: ComplexArray) -> FloatArray:
    return np.asarray(np.max(np.abs(poles), axis=-1))
