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
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear import StateSpace
from lbt_synth.linear.lyapunov import stationary_covariances
from lbt_synth.linear.matrix_functions import transpose
from lbt_synth.linear.quadrature import adaptive_integral, graded_edges, panel_rule
from lbt_synth.models import ARModel, Atmosphere, Spectrum
from lbt_synth.models.mirror.frame_rate_system import Hold
from lbt_synth.models.spectra import breakpoints_below, companions, densities, spectrum_density
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import fact, fact_table, facts
from lbt_synth.storage.summaries import Summarised, Summary
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy

# from cycles per frame (f,), the share (f,) of a phase that its means are, and entries (k or 1, n,
# w), to the rows of a loop, piece by piece
_Response: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], Iterable[ComplexArray]]

STILL = Hold(start=0.0, edges=np.array([0.0, 1.0]), C=np.zeros((1, 0)), D=np.ones(1))
_RESIDUAL = 1e-9  # of a Lyapunov equation, relative
_ROUNDING = 1e-8  # of the terms of a variance, the least part that it is computed from
_WIDENINGS = 16  # panels beside a pole, each four times as long as the one before
_ORDER = 10  # of the rule on a panel; 6 leaves errors of 3e-6
_ORIGINS = {
    "turbulence": "turbulence",
    "vibration": "vibrations",
    "noise": "noise",
    "within": "within frames",
}


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
    modes: int
    frame_rate_hz: float
    roots: ComplexArray  # where responses have resonances
    hold: Hold | None
    start: FloatArray  # of the holds [frames], (k,)
    in_image: bool  # whether what moves within a frame counts
    phases: int  # of the period of one loop; 1 for many loops
    response: _Response | None = None  # from unit phases to the rows, in fewer operations

    def of_density(
        self,
        density: Callable[[FloatArray], FloatArray],
        entry: FloatArray,
        edges_hz: FloatArray,
    ) -> FloatArray:
        """Return what phases of a density (f, k or 1) leave by an entry (k or 1, n, w)."""
        nyquist, along = self.frame_rate_hz / 2, np.asarray(entry @ transpose(entry))
        edges = np.union1d(graded_edges(self.roots) * nyquist, edges_hz)

        def left(f_hz: FloatArray) -> FloatArray:
            f = f_hz / self.frame_rate_hz
            mean: ComplexArray = np.zeros(1, dtype=np.complex128)
            squares = np.zeros(1)
            for weight, piece in self._pieces(f, entry):
                mean = mean + weight * piece
                squares = squares + weight * _power(piece)
            of_mean = _power(mean)
            within = squares - of_mean
            if self.in_image:
                rest = 1 - np.abs(self._holds.phase_means(f)) ** 2 @ self._holds.weights
                within += np.moveaxis(along, 0, -1)[:, :, None] * rest[:, None]
            return np.moveaxis(np.array([of_mean, within]) * density(f_hz), (3, 4), (0, 1))

        return adaptive_integral(left, edges)

    def of_process(
        self, coefficients: FloatArray, driving_rms_nm: FloatArray, entry: FloatArray
    ) -> FloatArray:
        """Return what processes of means over frames leave by the columns of an entry."""
        rate = self.frame_rate_hz
        if self.hold is not None:

            def density(f_hz: FloatArray) -> FloatArray:
                of_means = densities(coefficients, driving_rms_nm, rate, f_hz).T
                return np.asarray(of_means / np.sinc(f_hz / rate)[:, None] ** 2)

            poles = process_poles(coefficients).ravel()
            return self.of_density(density, entry, graded_edges(poles) * rate / 2)
        out = np.zeros((len(self.A), 2, self.modes, self.modes))
        first = np.eye(coefficients.shape[1], 1)
        process = companions(coefficients), driving_rms_nm[:, None, None] * first, first.T[None]
        inputs = np.zeros((len(entry), self.B.shape[-1], entry.shape[-1]))
        inputs[:, : self.modes] = entry
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
            if isinstance(spectrum, Atmosphere) and spectrum.is_stack:
                shapes, which, factor = spectrum.factored_psd(f_hz)
                return np.asarray(shapes.T[:, which] * factor)
            return spectrum_density(spectrum, f_hz)[:, None]

        return self.of_density(density, entry, breakpoints_below(spectrum, self.frame_rate_hz / 2))

    def of_noise(self, factor: FloatArray) -> FloatArray:
        """Return what white noise of covariance ``factor factor'`` leaves, (k or 1, q, p)."""
        covariance = self.shaken(factor).output_covariances()
        n, w = self.modes, self._holds.weights
        blocks = covariance.reshape(len(covariance), w.size, n, w.size, n)
        mean = np.einsum("g,kgihj,h->kij", w, blocks, w)
        return np.stack([mean, np.einsum("g,kgigj->kij", w, blocks) - mean], axis=1)

    def of_sinusoids(self, f: FloatArray, entry: ComplexArray) -> tuple[ComplexArray, FloatArray]:
        """Return amplitudes (k, n) that sinusoids leave, and covariances (k, n, n) within.

        Frequencies [cycles per frame] are (k,), the entries (k or 1, n + q) complex amplitudes.
        """
        n, share = self.modes, np.ones((len(f), entry.shape[-1]))
        if self.in_image:
            share[:, :n] = np.sinc(f)[:, None]
        follow = (self._at(f) @ (share * entry)[..., None])[..., 0]
        pieces, along = follow.reshape(len(f), -1, n), entry[:, None, :n]
        rest = 1 - np.abs(share[:, 0]) ** 2
        w = self._holds.weights
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
        whole = np.zeros((len(self.A), size, size))
        drive = np.zeros((len(self.A), size, B.shape[-1]))
        whole[:, :n, :n], whole[:, :n, n:], whole[:, n:, n:] = self.A, self.B @ samples, A
        drive[:, n:] = B
        rows = np.concatenate([self.C, self.D @ samples], axis=2)
        direct = np.zeros((*rows.shape[:2], drive.shape[2]))
        return replace(self, A=whole, B=drive, C=rows, D=direct, response=None)

    def shaken(self, factor: FloatArray) -> Evaluator:
        """Return the loops from white noise that enters the measurements by a factor."""
        n = self.modes
        B, D = self.B[..., n:] @ factor, self.D[..., n:] @ factor
        return replace(self, B=B, D=D, response=None)

    def system(self) -> StateSpace:
        """Return the one loop."""
        parts = [self.A, self.B, self.C, self.D]
        if self.phases == 1:
            A, B, C, D = (part[0] for part in parts)
            return StateSpace(A=A, B=B, C=C, D=D, dt_s=1 / self.frame_rate_hz).balanced()
        A, B, C, D = parts
        return StateSpace(A=A, B=B, C=C, D=D, dt_s=1 / self.frame_rate_hz)

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
            parts = {name: getattr(self, name)[i] for name in "ABCD"}
            out[i] = StateSpace(**parts).output_covariances()[0]
        if not np.all(np.isfinite(out)):
            raise ProblemError(
                "the covariance of a process in a loop was not found. The process or the loop is "
                "nearly a random walk; damp it."
            )
        return out

    @property
    def _holds(self) -> Hold:
        return STILL if self.hold is None else self.hold

    def _pieces(self, f: FloatArray, entry: FloatArray) -> Iterator[tuple[float, ComplexArray]]:
        """Yield the length of each piece of a hold, and what phases leave (n, w, f, k)."""
        share = np.sinc(f) if self.in_image else np.ones(f.size)
        rows = (self.response or self._response)(f, share, entry)
        if self.hold is None:
            yield from ((1.0, left) for left in rows)
            return
        # as seen from the middle of the frame, where the mean has its phase
        turn = 2 * np.pi * f[:, None] * (self.start - self.hold.start - 0.5)
        late = np.empty(turn.shape, dtype=np.complex128)
        np.cos(turn, out=late.real)  # a complex exp takes twice as long
        np.sin(turn, out=late.imag)
        means, enters = self.hold.phase_means(f), np.moveaxis(entry, 0, -1)[:, :, None]
        for g, (weight, positions) in enumerate(zip(self.hold.weights, rows, strict=True)):
            left = (means[:, g, None] * enters) * late
            left -= positions
            yield float(weight), left

    def _response(self, f: FloatArray, share: FloatArray, entry: FloatArray) -> ComplexArray:
        """Return the rows of one loop for phases whose means are a share, (g, n, w, f, k)."""
        used = np.flatnonzero(np.any(entry[0], axis=1))
        s = self.system()
        s = replace(s, B=s.B[..., used], D=s.D[..., used])
        response = s.phase_response(f * self.frame_rate_hz)
        rows = np.einsum("f,fkru,uw->rwfk", share, response, entry[0, used])
        return np.asarray(rows.reshape(-1, self.modes, *rows.shape[1:]))

    def _at(self, f: FloatArray) -> ComplexArray:
        """Return the responses (k, r, n + q) of loops, each at its own frequency."""
        if self.phases > 1:
            return np.asarray(self.system().phase_response(f[:1] * self.frame_rate_hz)[0])
        pencil = np.exp(2j * np.pi * f)[:, None, None] * np.eye(self.A.shape[1]) - self.A
        return np.asarray(self.C @ np.linalg.solve(pencil, self.B + 0j) + self.D)


def _power(left: ComplexArray) -> FloatArray:
    """Powers (n, n, f, k) of residuals (n, w, f, k), summed over the columns."""
    x, y = left.real, left.imag
    out = x[:, None, 0] * x[:, 0]
    out += y[:, None, 0] * y[:, 0]
    for i in range(1, left.shape[1]):
        out += x[:, None, i] * x[:, i] + y[:, None, i] * y[:, i]
    return np.asarray(out)


def process_poles(coefficients: FloatArray) -> ComplexArray:
    """Poles of processes, (k, r)."""
    return np.linalg.eigvals(companions(coefficients)).astype(np.complex128)


def block_diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """Return stacks of matrices (..., m, n) along the diagonals of larger ones."""
    stack = np.broadcast_shapes(*(block.shape[:-2] for block in blocks))
    rows, columns = np.sum([block.shape[-2:] for block in blocks], axis=0)
    out = np.zeros((*stack, rows, columns))
    i = j = 0
    for block in blocks:
        m, n = block.shape[-2:]
        out[..., i : i + m, j : j + n] = block
        i, j = i + m, j + n
    return out


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualBudget(Summarised):
    """Stationary residual of a loop, by origin; of p loops, all have a first axis (p,).

    Attributes
    ----------
    turbulence_nm2, noise_nm2, random_vibration_nm2 : (n, n) ndarray
        Covariances over the modes [nm^2], of means over the hold of a command.
    within_nm2 : (n, n) ndarray
        Covariance of what moves within the hold of a command [nm^2]; zero in means over frames.
    line_amplitudes_nm : (s, n) complex ndarray
        Complex amplitude that each sinusoid leaves on each mode [nm], of such means.
    stable : bool
        Whether the loop is stable; what an unstable one leaves is nan.
    """

    turbulence_nm2: FloatArray
    noise_nm2: FloatArray
    random_vibration_nm2: FloatArray
    within_nm2: FloatArray
    line_amplitudes_nm: ComplexArray
    stable: Any = True

    def _brief(self) -> str:
        modes, loops = self.noise_nm2.shape[-1], self.noise_nm2.shape[:-2]
        if loops:
            return f"{loops[0]} loops, {modes} modes"
        return f"{nm_text(self.rms_nm, '.4g')} rms, {modes} modes"

    def _summarise(self) -> Summary:
        headings = {"rms_nm": "residual"} | {
            f"{name}_nm": f"  {heading}" for name, heading in _ORIGINS.items()
        }
        nm = {"unit": "nm rms", "format": ".1f"}
        named = {name: fact(getattr(self, name), text, **nm) for name, text in headings.items()}
        rows = facts(**named)
        return Summary(tables=[fact_table("Residual", rows)])

    @property
    def gaussian_nm2(self) -> FloatArray:
        """Covariance of all that is Gaussian [nm^2]."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.random_vibration_nm2
        return frozen_copy(steady + self.within_nm2)

    @property
    def vibration_nm2(self) -> FloatArray:
        """Covariance of all vibrations, the sinusoids by their mean power [nm^2]."""
        a = self.line_amplitudes_nm
        return frozen_copy(self.random_vibration_nm2 + np.real(transpose(a) @ a.conj()) / 2)

    @property
    def total_nm2(self) -> FloatArray:
        """Covariance of the residual [nm^2]."""
        steady = self.turbulence_nm2 + self.noise_nm2 + self.vibration_nm2
        return frozen_copy(steady + self.within_nm2)

    @property
    def rms_nm(self) -> Any:
        """Residual over all modes [nm rms]."""
        return _rms(self.total_nm2)

    @property
    def turbulence_nm(self) -> Any:
        """Residual turbulence over all modes [nm rms]."""
        return _rms(self.turbulence_nm2)

    @property
    def vibration_nm(self) -> Any:
        """Residual vibration over all modes [nm rms]."""
        return _rms(self.vibration_nm2)

    @property
    def noise_nm(self) -> Any:
        """Propagated noise over all modes [nm rms]."""
        return _rms(self.noise_nm2)

    @property
    def within_nm(self) -> Any:
        """What moves within frames over all modes, which no command follows [nm rms]."""
        return _rms(self.within_nm2)


def _rms(covariance: FloatArray) -> Any:
    root = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    return root if root.ndim else float(root)
