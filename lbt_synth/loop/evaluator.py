"""What loops leave, exactly: the one evaluator, for many loops and for the phases of a period.

The camera sees the phase less the mirror's position at every moment. A command holds for one frame
from its arrival on, so that the mean square over a frame is that of the mean over the hold, less
the mirror, and of what moves within the hold. With a settled mirror the second is the phase's own:
no command follows it (C. Kulcsar, H.-F. Raynaud, C. Petit, J.-M. Conan, P. Viaris de Lesegno, Opt.
Express 14, 7464 (2006), doi:10.1364/OE.14.007464).

White noise and, where a hold is a frame, sampled processes are solved by Lyapunov equations, all
else by adaptive quadrature on panels that are short around the poles, sinusoids by the response. A
sampled process is one of means over frames, whose density in the continuous phase is larger by
``1 / sinc^2(f / f_s)``; spectra, and the rms of vibrations, are of the continuous phase. Nothing
lies above half the frame rate.

Many loops are split into parts that do not act on each other; equal parts are evaluated once.
Between two whole delays a settled mirror shows the commands of two frames within an exposure, so
that every matrix of the loop is affine in the fraction, as it is in the sensor gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.linear.matrix_functions import component_labels, transpose
from lbt_synth.linear.quadrature import adaptive_integral, graded_edges, panel_rule
from lbt_synth.linear.state_space import stacked_response
from lbt_synth.loop.closed_loop import STABILITY_MARGIN, ClosedLoop, last_frame, loop_matrices
from lbt_synth.models import ARModel, Atmosphere, LoopHardware, Spectrum
from lbt_synth.models.mirror.frame_rate_system import Hold, Response, mirror_system, tapped_mirror
from lbt_synth.models.spectra import breakpoints_below, companions, densities, spectrum_density
from lbt_synth.validation import BoolArray, ComplexArray, FloatArray, IntArray

Matrices: TypeAlias = tuple[FloatArray, ...]  # A, B, C, D in textbook form, (1 or p, ., .) each
# the modes and measurements of each of c equal parts, (c, n) and (c, q), the matrices of their
# controllers, the sensor (q, n) and the influence (n, m)
Part: TypeAlias = tuple[IntArray, IntArray, Matrices, FloatArray, FloatArray]

STILL = Hold(start=0.0, edges=np.array([0.0, 1.0]), C=np.zeros((1, 0)), D=np.ones(1))
_RESIDUAL = 1e-9  # of a Lyapunov equation, relative
_ROUNDING = 1e-8  # of the terms of a variance, the least part that it is computed from
_ZERO = 1e-13  # smaller entries, relative to the largest of their matrix, count as zero
_WIDENINGS = 16  # panels beside a pole, each four times as long as the one before
_ORDER = 10  # of the rule on a panel; 6 leaves errors of 3e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluator:
    """What counts as the residual of k loops of n modes, or of one loop in each of k phases.

    Without a hold it is the mean over a frame, and the rows of ``A, B, C, D`` from ``[phi_tot (n),
    noise (q)]`` are the residual (n). With one they are the mirror's mean positions in its pieces
    (g n). What the methods return are pairs (k, 2, n, n): the covariance of the mean over a hold,
    and of what moves within it.
    """

    A: FloatArray  # (k, s, s)
    B: FloatArray
    C: FloatArray
    D: FloatArray
    modes: IntArray  # numbers of the modes of each of c equal parts, (c, n)
    measurements: IntArray  # (c, q)
    frame_rate_hz: float
    roots: ComplexArray  # where responses have resonances, (k, .) or those of a period (1, .)
    hold: Hold | None
    start: FloatArray  # of the holds [frames], (k,)
    in_image: bool  # whether what moves within a frame counts
    phases: int  # of the period of one loop; 1 for many loops

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.modes.shape[1])

    def take(self, which: IntArray) -> Evaluator:
        """Return some of many loops."""
        return replace(
            self, **{name: getattr(self, name)[which] for name in [*"ABCD", "roots", "start"]}
        )

    def powers(self, entry: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return the powers (2, n, n, f, k) that phases of unit density leave, of frequencies [Hz].

        They enter by an entry (k or 1, n, w).
        """
        weights, respond = (self.hold or STILL).weights, self._pieces(entry)
        along = np.moveaxis(entry @ transpose(entry), 0, -1)[:, :, None]

        def powers(f_hz: FloatArray) -> FloatArray:
            f = f_hz / self.frame_rate_hz
            pieces = respond(f)
            of_mean = _power(pieces[0] if len(pieces) == 1 else np.tensordot(weights, pieces, 1))
            out = np.stack([of_mean, np.zeros_like(of_mean)])
            if len(pieces) > 1:
                squares = [w * _power(piece) for w, piece in zip(weights, pieces, strict=True)]
                out[1] = np.sum(squares, axis=0) - of_mean
            if self.in_image:
                rest = 1 - np.abs((self.hold or STILL).phase_means(f)) ** 2 @ weights
                out[1] += along * rest[:, None]
            return out

        return powers

    def of_density(
        self,
        density: Callable[[FloatArray], FloatArray],
        entry: FloatArray,
        edges_hz: FloatArray,
    ) -> FloatArray:
        """Return what phases of a density (f, k or 1) leave by an entry (k or 1, n, w)."""
        edges = np.union1d(graded_edges(self.roots.ravel()) * self.frame_rate_hz / 2, edges_hz)
        powers = self.powers(entry)

        def weighted(f_hz: FloatArray) -> FloatArray:
            return np.moveaxis(powers(f_hz) * density(f_hz), (3, 4), (0, 1))

        return adaptive_integral(weighted, edges)

    def of_process(
        self, coefficients: FloatArray, driving_rms_nm: FloatArray, entry: FloatArray
    ) -> FloatArray:
        """Return what processes of means over frames leave by the columns of an entry."""
        rate, n = self.frame_rate_hz, self.n_modes
        if self.hold is not None:

            def density(f_hz: FloatArray) -> FloatArray:
                of_means = densities(coefficients, driving_rms_nm, rate, f_hz).T
                return np.asarray(of_means / np.sinc(f_hz / rate)[:, None] ** 2)

            poles = process_poles(coefficients).ravel()
            return self.of_density(density, entry, graded_edges(poles) * rate / 2)
        out = np.zeros((len(self.A), 2, n, n))
        first = np.eye(coefficients.shape[1], 1)
        process = companions(coefficients), driving_rms_nm[:, None, None] * first, first.T[None]
        inputs = np.zeros((len(entry), self.B.shape[-1], entry.shape[-1]))
        inputs[:, :n] = entry
        for column in range(entry.shape[-1]):
            driven = self.driven(*process, inputs[..., [column]])
            out[:, 0] += driven.output_covariances()
        if self.in_image:
            power = power_within_frames(coefficients, driving_rms_nm, rate)
            out[:, 1] = power[:, None, None] * (entry @ transpose(entry))
        return out

    def of_turbulence(self, spectrum: Spectrum, entry: FloatArray) -> FloatArray:
        """Return what phases of a spectrum leave, or of sampled processes."""
        if isinstance(spectrum, ARModel):
            coefficients = np.atleast_2d(spectrum.coefficients)
            return self.of_process(coefficients, np.atleast_1d(spectrum.driving_rms_nm), entry)

        def density(f_hz: FloatArray) -> FloatArray:
            if isinstance(spectrum, Atmosphere) and np.ndim(spectrum.wind_speed_m_s):
                return spectrum.psd(f_hz).T
            return spectrum_density(spectrum, f_hz)[:, None]

        return self.of_density(density, entry, breakpoints_below(spectrum, self.frame_rate_hz / 2))

    def of_noise(self, factor: FloatArray) -> FloatArray:
        """Return what white noise of covariance ``factor factor'`` leaves, (k or 1, q, p)."""
        n, w = self.n_modes, (self.hold or STILL).weights
        B, D = self.B[..., n:] @ factor, self.D[..., n:] @ factor
        covariance = replace(self, B=B, D=D).output_covariances()
        blocks = covariance.reshape(len(covariance), w.size, n, w.size, n)
        mean = np.einsum("g,kgihj,h->kij", w, blocks, w)
        return np.stack([mean, np.einsum("g,kgigj->kij", w, blocks) - mean], axis=1)

    def of_sinusoids(self, f: FloatArray, entry: ComplexArray) -> tuple[ComplexArray, FloatArray]:
        """Return amplitudes (k, n) that sinusoids leave, and covariances (k, n, n) within.

        Frequencies [cycles per frame] are (k,), the entries (k or 1, n + q) complex amplitudes.
        """
        n, share = self.n_modes, np.ones((len(f), entry.shape[-1]))
        if self.in_image:
            share[:, :n] = np.sinc(f)[:, None]
        follow = (self._at(f) @ (share * entry)[..., None])[..., 0]
        pieces, along = follow.reshape(len(f), -1, n), entry[:, None, :n]
        rest = 1 - np.abs(share[:, 0]) ** 2
        w = (self.hold or STILL).weights
        if self.hold is not None:  # with the phase that each has in its own hold
            means = self.hold.phase_means(f)
            rest = 1 - np.abs(means) ** 2 @ w
            late = f * (self.start - self.hold.start - 0.5)
            pieces = (means * np.exp(2j * np.pi * late)[:, None])[..., None] * along - pieces
            pieces = pieces * np.exp(-2j * np.pi * f * self.start)[:, None, None]
        mean = np.einsum("g,kgi->ki", w, pieces)
        apart = pieces - mean[:, None]
        within = np.real(np.einsum("g,kgi,kgj->kij", w, apart, apart.conj())) / 2
        line = np.real(np.einsum("kgi,kgj->kij", along, along.conj()))
        return mean, within + rest[:, None, None] * line / 2

    def driven(self, A: FloatArray, B: FloatArray, C: FloatArray, entry: FloatArray) -> Evaluator:
        """Return the loops from the drives of processes that enter them, (k or 1, n + q, w).

        A process x(j + 1) = A x(j) + B w(j) has acted by the time of its newest sample.
        """
        samples, n, size = entry @ C, self.A.shape[-1], self.A.shape[-1] + A.shape[-1]
        joined = np.zeros((len(self.A), size, size))
        drive = np.zeros((len(self.A), size, B.shape[-1]))
        joined[:, :n, :n], joined[:, :n, n:], joined[:, n:, n:] = self.A, self.B @ samples, A
        drive[:, n:] = B
        rows = np.concatenate([self.C, self.D @ samples], axis=2)
        direct = np.zeros((*rows.shape[:2], drive.shape[2]))
        return replace(self, A=joined, B=drive, C=rows, D=direct)

    def system(self) -> StateSpace:
        """Return the one loop."""
        A, B, C, D = (part[0] if self.phases == 1 else part for part in self._matrices)
        system = StateSpace(A=A, B=B, C=C, D=D, dt_s=1 / self.frame_rate_hz)
        return system.balanced() if self.phases == 1 else system

    def output_covariances(self) -> FloatArray:
        """Return covariances (k, r, r) for white inputs, by roots where digits are lost."""
        if len(self.A) == self.phases:
            return self.system().output_covariances()
        drive = self.B @ transpose(self.B)
        X, residuals = stationary_covariances(self.A, drive)
        out = np.asarray(self.C @ X @ transpose(self.C) + self.D @ transpose(self.D))
        terms = np.abs(self.C) @ np.abs(X) @ transpose(np.abs(self.C))
        poor = np.trace(terms, axis1=1, axis2=2) * _ROUNDING > np.trace(out, axis1=1, axis2=2)
        for i in np.flatnonzero(~((residuals < _RESIDUAL) & ~poor)):
            A, B, C, D = (part[i] for part in self._matrices)
            out[i] = StateSpace(A=A, B=B, C=C, D=D).output_covariances()[0]
        if not np.all(np.isfinite(out)):
            raise ProblemError(
                "the covariance of a process in a loop was not found. The process or the loop is "
                "nearly a random walk; damp it."
            )
        return out

    @property
    def _matrices(self) -> Matrices:
        return self.A, self.B, self.C, self.D

    def _pieces(self, entry: FloatArray) -> Callable[[FloatArray], ComplexArray]:
        """Return what phases leave in each piece of a hold, (g, n, w, f, k), of frequencies."""
        n = self.n_modes
        entered = replace(self, B=self.B[..., :n] @ entry, D=self.D[..., :n] @ entry)
        enters = np.moveaxis(entry, 0, -1)[:, :, None]
        respond: Callable[[FloatArray], ComplexArray]
        if len(self.A) == self.phases:
            one = entered.system()
            respond = lambda f: one.phase_response(f * self.frame_rate_hz)  # noqa: E731
        else:
            many = stacked_response(entered._matrices)
            respond = lambda f: many(np.exp(2j * np.pi * f))  # noqa: E731

        def pieces(f: FloatArray) -> ComplexArray:
            rows = np.moveaxis(respond(f), (2, 3), (0, 1))  # (g n, w, f, k)
            rows = rows.reshape(-1, n, *rows.shape[1:])
            if self.in_image:
                rows = rows * np.sinc(f)[:, None]
            if self.hold is None:
                return np.asarray(rows)
            # as seen from the middle of the frame, where the mean has its phase
            late = np.exp(2j * np.pi * f[:, None] * (self.start - self.hold.start - 0.5))
            means = self.hold.phase_means(f).T[:, None, None, :, None]
            return np.asarray(means * enters * late - rows)

        return pieces

    def _at(self, f: FloatArray) -> ComplexArray:
        """Return the responses (k, r, n + q) of loops, each at its own frequency."""
        if self.phases > 1:
            return np.asarray(self.system().phase_response(f[:1] * self.frame_rate_hz)[0])
        pencil = np.exp(2j * np.pi * f)[:, None, None] * np.eye(self.A.shape[1]) - self.A
        return np.asarray(self.C @ np.linalg.solve(pencil, self.B + 0j) + self.D)


def _power(phases: ComplexArray) -> FloatArray:
    """Powers (n, n, f, k) of residuals (n, w, f, k), summed over the columns."""
    x = np.concatenate([phases.real, phases.imag], axis=1)
    return np.asarray(np.einsum("iwfk,jwfk->ijfk", x, x))


def process_poles(coefficients: FloatArray) -> ComplexArray:
    """Poles of processes, (k, r)."""
    return np.linalg.eigvals(companions(coefficients)).astype(np.complex128)


def power_within_frames(
    coefficients: FloatArray, driving_rms_nm: FloatArray, frame_rate_hz: float
) -> FloatArray:
    """Integral of ``S (1 / sinc^2 - 1)`` of processes: the power that moves within frames, (k,)."""
    poles = process_poles(coefficients)
    centre, width = np.abs(np.angle(poles)), np.maximum(1 - np.abs(poles), 1e-9)
    steps = np.concatenate([[0.0], 4.0 ** np.arange(_WIDENINGS)])
    offsets = (width[..., None] * steps).reshape(len(poles), -1)
    middle = np.repeat(centre, steps.size, axis=1)
    fixed = np.broadcast_to(np.geomspace(1e-6, 1, 12) * np.pi, (len(poles), 12))
    ends = np.concatenate([middle - offsets, middle + offsets, fixed, 0 * fixed[:, :1]], axis=1)
    edges = np.sort(np.clip(ends, 0, np.pi), axis=1)
    angle, weights = panel_rule(edges[:, :-1].ravel(), edges[:, 1:].ravel(), _ORDER)
    angle, weights = (one.reshape(len(poles), -1) for one in (angle, weights))
    shifts = np.exp(-1j * angle[..., None] * np.arange(1, coefficients.shape[1] + 1))
    gain = np.abs(1 - np.einsum("kar,kr->ka", shifts, coefficients)) ** -2
    moving = 1 / np.sinc(angle / (2 * np.pi)) ** 2 - 1
    return np.asarray(np.square(driving_rms_nm) * np.sum(weights * gain * moving, axis=1) / np.pi)


def loop_evaluator(loop: ClosedLoop, *, in_image: bool) -> Evaluator:
    """Return the evaluator of one loop, with each phase of its period."""
    hardware, s = loop.hardware, loop.system
    settled = hardware.mirror is None and hardware.delay_frames % 1 == 0
    n = hardware.modes
    return _evaluator(
        s.stacks(),
        hardware.influence,
        modes=np.arange(n)[None],
        measurements=np.arange(s.B.shape[-1] - n)[None],
        first=loop.controller.n_states,
        frame_rate_hz=hardware.frame_rate_hz,
        roots=period_roots(s.poles, s.period)[None],
        hold=hardware.mirror_system.hold if in_image and not settled else None,
        start=np.full(s.period, hardware.delay_frames - 1),
        in_image=in_image,
        phases=s.period,
    )


def _evaluator(
    matrices: Matrices, influence: FloatArray, *, first: int, hold: Hold | None, **facts: Any
) -> Evaluator:
    """Return the evaluator of loops to ``[phi_res, u, ...]``, with the mirror's states behind."""
    n, m = influence.shape
    A, B, C, D = matrices
    if hold is None:
        C, D = C[:, :n], D[:, :n]
    else:
        C, D = hold.positions(influence, (C[:, n : n + m], D[:, n : n + m]), first)
        C, D = (rows.reshape(len(rows), -1, rows.shape[-1]) for rows in (C, D))
    return Evaluator(A=A, B=B, C=C, D=D, hold=hold, **facts)


def period_roots(poles: ComplexArray, period: int) -> ComplexArray:
    """Return where the poles of a period show in a response: at each of their roots."""
    turns = np.exp(2j * np.pi * np.arange(period) / period)
    roots = np.abs(poles) ** (1 / period) * np.exp(1j * np.angle(poles) / period)
    return np.asarray((roots[:, None] * turns).ravel())


def textbook_matrices(controllers: Sequence[Controller]) -> Matrices:
    """Return controllers of as many states as balanced ``A, B, C, D`` in textbook form."""
    systems = [controller.to_statespace().balanced() for controller in controllers]
    return tuple(np.stack([getattr(system, name) for system in systems]) for name in "ABCD")


def close_loops(
    matrices: Matrices,
    hardware: LoopHardware,
    sensor_gains: FloatArray,
    delay_frames: FloatArray,
    *,
    in_image: bool = True,
    together: Sequence[BoolArray] = (),
) -> tuple[BoolArray, list[tuple[IntArray, list[Evaluator]]]]:
    """Close loops of controllers at gains and delays (p,); return their stability (p,).

    Loops of the same whole delay come with it, by their numbers (k,): an evaluator for each part.
    Modes that one line shakes ``together``, (n,) for each, are in one part.
    """
    stable = np.ones(sensor_gains.size, dtype=np.bool_)
    parts, rest = split_into_parts(matrices, hardware, together)
    for A in rest:
        stable &= _are_stable(np.linalg.eigvals(A).astype(np.complex128))
    groups = []
    for rows, fraction, mirrors, hold in _mirrors_by_delay(hardware, delay_frames):
        seen = hold or (STILL if np.any(fraction) else None)
        evaluators = []
        for modes, measurements, controllers, sensor, influence in parts:
            one = len(controllers[0]) == 1
            controllers = controllers if one else tuple(matrix[rows] for matrix in controllers)
            path = partial(loop_matrices, readings=last_frame(sensor), influence=influence)
            ends = [path(*controllers, mirror=mirror) for mirror in mirrors]
            share, gain = fraction[:, None, None], sensor_gains[rows, None, None]
            A0, A1, B, C0, C1, D = (
                one + share * (two - one) for one, two in zip(*ends, strict=True)
            )
            closed = A0 + gain * A1, B, C0 + gain * C1, D
            poles = np.linalg.eigvals(closed[0]).astype(np.complex128)
            stable[rows] &= _are_stable(poles)
            part = _evaluator(
                closed,
                influence,
                modes=modes,
                measurements=measurements,
                first=controllers[0].shape[-1],
                frame_rate_hz=hardware.frame_rate_hz,
                roots=poles,
                hold=seen if in_image else None,
                start=delay_frames[rows] - 1,
                in_image=in_image,
                phases=1,
            )
            evaluators.append(part)
        groups.append((rows, evaluators))
    return stable, groups


def split_into_parts(
    matrices: Matrices, hardware: LoopHardware, together: Sequence[BoolArray] = ()
) -> tuple[list[Part], list[FloatArray]]:
    """Split a loop into independent parts, equal ones once, and what reaches no mode.

    Modes that are ``together``, (n,) for each, stay in one part.
    """
    A, B, C, D = matrices
    sensor, influence = hardware.sensor, hardware.influence
    s, q, m, n = A.shape[-1], B.shape[-1], C.shape[-2], hardware.modes
    x, y, u, r = np.split(np.arange(s + q + m + n), np.cumsum([s, q, m]))
    links = np.zeros((s + q + m + n, s + q + m + n), dtype=np.bool_)
    controller = (x, x, A), (x, y, B), (u, x, C), (u, y, D)
    for rows, columns, entries in (*controller, (y, r, sensor[None]), (r, u, influence[None])):
        sizes = np.abs(entries)
        largest = np.max(sizes, axis=(1, 2), keepdims=True, initial=0.0)
        links[np.ix_(rows, columns)] = np.any(sizes > _ZERO * largest, axis=0)
    for shaken in together:
        links[np.ix_(r[shaken], r[shaken])] = True
    label = component_labels(links)
    parts: dict[tuple[bytes, ...], Part] = {}
    rest = []
    for i in range(np.max(label) + 1):
        states, inputs, commands, modes = (np.flatnonzero(label[k] == i) for k in (x, y, u, r))
        entry, leaving = states[:, None], commands[:, None]
        law = A[:, entry, states], B[:, entry, inputs], C[:, leaving, states], D[:, leaving, inputs]
        path = sensor[np.ix_(inputs, modes)], influence[np.ix_(modes, commands)]
        key = tuple(matrix.tobytes() for matrix in (*law, *path))
        if modes.size and key in parts:
            modes = np.vstack([parts[key][0], modes])
            inputs = np.vstack([parts[key][1], inputs])
        if modes.size:
            parts[key] = np.atleast_2d(modes), np.atleast_2d(inputs), law, *path
        elif states.size:
            rest.append(law[0])
    return list(parts.values()), rest


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
    for frames in np.unique(lead):
        rows = np.flatnonzero(lead == frames)
        taps = np.zeros((2, frames + (2 if np.any(fraction[rows] > 0) else 1)))
        taps[0, frames] = taps[1, -1] = 1.0
        yield rows, fraction[rows], (tapped_mirror(taps[0]), tapped_mirror(taps[1])), None


def _are_stable(poles: ComplexArray) -> BoolArray:
    return np.asarray(np.max(np.abs(poles), axis=-1) < 1 - STABILITY_MARGIN)
