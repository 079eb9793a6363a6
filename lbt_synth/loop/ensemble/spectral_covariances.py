"""Residuals that spectra and white noise leave in the loops of one subloop, by quadrature.

One set of frequencies serves all loops of a batch. It is refined around all their poles, which
are known, so that a rule of fixed order is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import gauss_panels, panel_rule
from lbt_synth.linear.state_space import pointwise_response
from lbt_synth.loop.ensemble.closed_loops import LoopPoints, mirror_response, system_response
from lbt_synth.loop.ensemble.loop_ensemble import Turbulence
from lbt_synth.models import ARModel, Atmosphere, FrozenFlows, SumSpectrum, TabulatedSpectrum
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.models.turbulence.atmosphere import LOWEST, TAIL
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

ORDER = 10  # nodes per panel
# The tilt filter ripples with the inverse of the time that the wind takes over the pupil. Panels
# end at knots of the spectrum's spline, where it has them; for the fast winds they widen in steps.
_RIPPLES = np.concatenate(
    [np.arange(1, 3, 0.5), np.arange(3, 12, 1.25), TAIL[:56:4], TAIL[56:168:8], TAIL[168::16]]
)
_STEP = 0.08
_FLAT = 0.02  # a spectrum is flat below this fraction of the frequency V / L0
_SETTLED, _HALVINGS = 1e-8, 20  # of the panels of a spectrum of unknown shape
_COVERED = 1e-6  # fraction of Nyquist above which there are geometric panels in any case
_NARROWEST = 1e-10  # pole width that panels are still refined to, as a fraction of Nyquist
_PANEL = 2.0  # length of a panel over its distance from a pole, or over the pole's width
_PROBES = 5  # frequencies at which partial fractions are checked by solving linear systems
_AGREEMENT = 1e-9
_IN_CACHE = 16  # loops whose spectra are integrated at once: more do not fit the processor's cache
_PRODUCTS = 128  # the same where the integrals are products of matrices
_FEW_SHAPES = 16  # spectra that are integrated for all loops, where each needs one of them
_CANCELS = 1e-5  # |1 + g L|^2 below which its expansion has less than nine digits


@dataclass(frozen=True, slots=True, eq=False)
class _Density:
    """Weighted spectra of the turbulence of k loops, at the f frequencies of a quadrature."""

    shapes: FloatArray  # (u, f)
    which: IntArray  # shape of each loop, (k,)
    factor: FloatArray  # of each loop, (k,)
    modes: list[int]  # of the subloop

    @classmethod
    def of(
        cls, spectrum: Turbulence, modes: list[int], loops: int, nodes: tuple[FloatArray, ...]
    ) -> _Density:
        """Evaluate a spectrum at nodes, frequencies and weights (f,), for some loops."""
        frequency, weight = nodes
        if isinstance(spectrum, FrozenFlows):
            shapes, which, factor = spectrum.factored_psd(frequency)
        else:
            shapes, which, factor = spectrum.psd(frequency)[None], np.zeros(1, int), np.ones(1)
        whole = np.broadcast_to(which, loops), np.broadcast_to(factor, loops)
        return cls(shapes * weight, *whole, modes)

    def row(self, k: int) -> FloatArray:
        """Return the spectrum of a loop, (f,)."""
        return np.asarray(self.factor[k] * self.shapes[self.which[k]])

    def integrate(self, rejection: FloatArray, rows: slice) -> FloatArray:
        """Return the sums over the frequencies of what some loops leave of their spectra."""
        which = self.which[rows]
        if len(self.shapes) > _FEW_SHAPES:
            sums = np.einsum("kf,kf->k", rejection, self.shapes[which])
        else:
            sums = (rejection @ self.shapes.T)[np.arange(which.size), which]
        return np.asarray(self.factor[rows] * sums)


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """A subloop's elements and the spectra at the f frequencies of a quadrature."""

    delay: ComplexArray  # ``z^-1``
    first: ComplexArray  # of the group's two mirrors
    second: ComplexArray
    controller: ComplexArray  # (f, m, q), or (k, f, m, q) with one per loop
    white: FloatArray  # weighted spectrum of unit noise per frame, (f,)
    densities: list[_Density]


def spectral_covariances(
    group: LoopPoints,
    turbulence: list[tuple[Turbulence, list[int]]],
    noise_nm: FloatArray,
    frame_rate_hz: float,
) -> tuple[FloatArray, FloatArray]:
    """Covariances (k, n, n) of the residual from turbulence, and from noise (k, q).

    ``turbulence`` pairs each spectrum with its modes of the subloop.
    """
    samples = _sample(group, turbulence, frame_rate_hz)
    evaluate = _scalar_covariances if group.subloop.is_scalar else _matrix_covariances
    return evaluate(group, samples, noise_nm)


def _sample(
    group: LoopPoints, turbulence: list[tuple[Turbulence, list[int]]], frame_rate_hz: float
) -> _Samples:
    """Choose frequencies for the poles of a batch of loops, and evaluate its subloop there."""
    nyquist, subloop = frame_rate_hz / 2, group.subloop
    edges = [graded_edges(group.poles.ravel()) * nyquist]
    edges += [_breakpoints(spectrum, nyquist) for spectrum, _ in turbulence]
    frequency, weight = gauss_panels(np.unique(np.concatenate(edges)), ORDER)
    z = np.exp(1j * np.pi * frequency / nyquist)
    ends = (group.first,) if group.first is group.second else (group.first, group.second)
    mirrors = [mirror_response(mirror, z) for mirror in ends]
    A, B, C, D = subloop.controllers(group.rows)
    one = subloop.is_shared
    controller = (
        system_response(A[0], B[0], C[0], D[0], z) if one else batched_response(A, B, C, D, z)
    )
    loops, nodes = len(group.rows), (frequency, weight)
    densities = [_Density.of(spectrum, modes, loops, nodes) for spectrum, modes in turbulence]
    return _Samples(
        1 / z, mirrors[0], mirrors[-1], controller, 2 / frame_rate_hz * weight, densities
    )


def graded_edges(poles: ComplexArray) -> FloatArray:
    """Panels of (0, 1), as fractions of Nyquist, that are short where a pole is near.

    A panel is halved while it is longer than twice its distance from a pole, or than twice
    the width of a pole that it holds. Poles that differ by less than a quarter of their width count
    once.
    """
    upper = poles[poles.imag >= 0]
    centre = np.abs(np.angle(upper)) / np.pi
    width = np.maximum(1 - np.abs(upper), np.pi * _NARROWEST) / np.pi
    size = np.exp2(np.floor(np.log2(width)))
    distinct = np.unique(size + 1j * np.floor(4 * centre / size), return_index=True)[1]
    centre, width = centre[distinct], width[distinct]
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1, 24)])
    low, high = grid[:-1], grid[1:]
    done = [np.ones(1)]
    while low.size:
        outside = np.maximum(low[:, None] - centre, centre - high[:, None])
        nearest = np.min(np.maximum(outside, width), axis=1, initial=1.0)
        long = high - low > _PANEL * nearest
        done.append(low[~long])
        middle = (low[long] + high[long]) / 2
        low, high = np.concatenate([low[long], middle]), np.concatenate([middle, high[long]])
    return np.sort(np.concatenate(done))


def _breakpoints(spectrum: Turbulence, nyquist_hz: float) -> FloatArray:
    """Frequencies between which a spectrum is smooth [Hz]."""
    if isinstance(spectrum, SumSpectrum):
        return np.concatenate([_breakpoints(part, nyquist_hz) for part in spectrum.parts])
    if isinstance(spectrum, TabulatedSpectrum):
        return breakpoints_below(spectrum, nyquist_hz)
    if not isinstance(spectrum, Atmosphere | FrozenFlows):
        return _adaptive_breakpoints(spectrum, nyquist_hz)
    air = spectrum if isinstance(spectrum, Atmosphere) else spectrum.atmosphere
    wind = np.unique(spectrum.wind_speed_m_s) / air.diameter_m
    slow, fast = float(wind[0]), float(wind[-1])
    reach = np.geomspace(slow, fast, int(np.log(fast / slow) / _STEP) + 2)
    ripples = np.concatenate([slow * _RIPPLES, TAIL[-1] * reach])
    # below them it is flat, up to where the outer scale bends it
    outer = spectrum.outer_scale_m
    bend = LOWEST if outer is None else max(LOWEST, _FLAT * air.diameter_m / float(np.max(outer)))
    lowest = np.geomspace(min(bend, 1.0) * slow, slow, 18)
    points = np.concatenate([lowest[lowest < _COVERED * nyquist_hz], ripples])
    if bend == LOWEST:
        points = np.concatenate([points, LOWEST * wind])
    return points[points < nyquist_hz]


def _adaptive_breakpoints(spectrum: Turbulence, nyquist_hz: float) -> FloatArray:
    """Frequencies between which a spectrum of unknown shape needs no shorter panels [Hz].

    Peaks narrower than the first panels are found at the spectrum's breakpoints, or at its poles
    if it is auto-regressive.
    """
    grid = np.geomspace(_COVERED, 1, 200) * nyquist_hz
    edges = [np.zeros(1), grid, breakpoints_below(spectrum, nyquist_hz)]
    if isinstance(spectrum, ARModel):
        poles = np.linalg.eigvals(spectrum.companion).astype(np.complex128)
        edges.append(graded_edges(poles) * nyquist_hz)
    first = np.unique(np.concatenate(edges))
    low, high = first[:-1], first[1:]
    done = [high[-1:]]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        fine = _panel_integrals(spectrum, low, middle) + _panel_integrals(spectrum, middle, high)
        open_ = np.abs(fine - _panel_integrals(spectrum, low, high)) > _SETTLED * np.abs(fine)
        done.append(low[~open_])
        ends = low[open_], middle[open_], high[open_]
        low, high = np.concatenate(ends[:2]), np.concatenate(ends[1:])
        if not low.size:
            break
    return np.unique(np.concatenate([*done, low]))


def _panel_integrals(spectrum: Turbulence, low: FloatArray, high: FloatArray) -> FloatArray:
    """Integrals of a spectrum over panels that need not touch."""
    nodes, weights = panel_rule(low, high, ORDER)
    return np.asarray(np.sum(weights * spectrum.psd(nodes.ravel()).reshape(nodes.shape), axis=1))


def _scalar_covariances(
    group: LoopPoints, samples: _Samples, noise_nm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """One mode, in real numbers."""
    subloop = group.subloop
    controller = samples.controller[..., 0, 0]
    ends = subloop.unit_loop(controller, samples.first, samples.second, samples.delay)
    shared = _SharedLoop.of(*ends, samples.white) if subloop.is_shared else None
    turbulence, noise = np.zeros((2, len(group.rows)))
    step = _IN_CACHE if shared is None else _PRODUCTS
    for start in range(0, len(group.rows), step):
        rows = slice(start, start + step)
        gain, fraction = group.sensor_gains[rows], group.fraction[rows]
        if shared is None:
            first, second = (end[rows] for end in ends)
            rejection, noise[rows] = _rejections(gain, fraction, first, second, samples.white)
        else:
            rejection, noise[rows] = shared.rejections(gain, fraction)
        for density in samples.densities:  # each is of the one mode
            turbulence[rows] += density.integrate(rejection, rows)
    noise *= (noise_nm[:, 0] / subloop.sensor[0, 0]) ** 2
    return turbulence[:, None, None], noise[:, None, None]


def _rejections(
    gain: FloatArray,
    fraction: FloatArray,
    first: ComplexArray,
    second: ComplexArray,
    white: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return ``|S|^2 = 1 / |1 + g L|^2`` of k loops, (k, f), and the sums of ``white |S L|^2``.

    The loop at unit gain is ``first + fraction second``; both are (f,), or (k, f).
    """
    g, s = gain[:, None], fraction[:, None]
    real, imaginary = first.real + s * second.real, first.imag + s * second.imag
    rejection = 1 / ((1 + g * real) ** 2 + (g * imaginary) ** 2)
    return rejection, (rejection * (real**2 + imaginary**2)) @ white


@dataclass(frozen=True, slots=True, eq=False)
class _SharedLoop:
    """One loop at unit gain for many gains and fractions: ``|1 + g L|^2`` is a polynomial."""

    first: ComplexArray  # (f,)
    second: ComplexArray  # (f,)
    white: FloatArray  # (f,)
    terms: FloatArray  # of ``|1 + g L|^2``, (6, f)
    noise: FloatArray  # ``white |L|^2`` by powers of the fraction, (3, f)

    @classmethod
    def of(cls, first: ComplexArray, second: ComplexArray, white: FloatArray) -> _SharedLoop:
        """Expand a loop whose two ends are given."""
        cross = 2 * (first * second.conj()).real
        squares = np.array([abs(first) ** 2, cross, abs(second) ** 2])
        terms = np.array([np.ones_like(white), 2 * first.real, 2 * second.real, *squares])
        return cls(first, second, white, terms, white * squares)

    def rejections(self, gain: FloatArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what :func:`_rejections` does, as products of two matrices.

        The polynomial cancels next to instability, where it is not used.
        """
        powers = fraction[:, None] ** [0, 1, 2]
        mixed = [gain[:, None] * powers[:, :2], gain[:, None] ** 2 * powers]
        size = np.hstack([powers[:, :1], *mixed]) @ self.terms
        near = np.min(size, axis=1) < _CANCELS
        rejection = np.reciprocal(size, out=size)
        noise = np.sum((rejection @ self.noise.T) * powers, axis=1)
        if near.any():
            rejection[near], noise[near] = _rejections(
                gain[near], fraction[near], self.first, self.second, self.white
            )
        return rejection, noise


def _matrix_covariances(
    group: LoopPoints, samples: _Samples, noise_nm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Several modes, one loop at a time."""
    subloop, n = group.subloop, group.subloop.modes.size
    turbulence, noise = np.zeros((2, len(group.rows), n, n))
    for k, gain in enumerate(group.sensor_gains):
        share = group.fraction[k]
        mirror = (1 - share) * samples.first + share * samples.second
        controller = samples.controller if subloop.is_shared else samples.controller[k]
        path = subloop.influence @ (mirror[:, None, None] * controller)  # (f, n, q)
        loop = path @ (gain * subloop.sensor) * samples.delay[:, None, None]
        S = _inverses(np.eye(n) + loop)
        N = S @ (path * noise_nm[k])
        noise[k] = _gram(N, samples.white)
        for density in samples.densities:
            turbulence[k] += _gram(S[..., density.modes], density.row(k))
    return turbulence, noise


def _gram(transfer: ComplexArray, density: FloatArray) -> FloatArray:
    """Sum ``density T T*`` over the frequencies, real subloop."""
    parts = np.concatenate([transfer.real, transfer.imag], axis=2) * np.sqrt(density)[:, None, None]
    wide = np.swapaxes(parts, 0, 1).reshape(parts.shape[1], -1)
    return np.asarray(wide @ wide.T)


def _inverses(matrices: ComplexArray) -> ComplexArray:
    """Inverses of many matrices; two by two by their adjugates, several times faster."""
    if matrices.shape[-1] != 2:
        return np.asarray(np.linalg.inv(matrices))
    a, b, c, d = (matrices[..., i, j] for i in (0, 1) for j in (0, 1))
    scale = 1 / (a * d - b * c)
    out = np.empty_like(matrices)
    out[..., 0, 0], out[..., 1, 1] = scale * d, scale * a
    out[..., 0, 1], out[..., 1, 0] = -scale * b, -scale * c
    return out


def batched_response(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, z: ComplexArray
) -> ComplexArray:
    """Transfer matrices (k, f, m, q) of k systems at f points z, by partial fractions.

    A system whose eigenvectors are nearly dependent fails at some probes; its points are then
    solved one by one.
    """
    out = np.empty((len(A), z.size, C.shape[1], B.shape[2]), dtype=np.complex128)
    if A.shape[1] == 0:
        out[:] = D[:, None]
        return out
    poles, vectors = np.linalg.eig(A)
    with np.errstate(all="ignore"):  # what is not finite fails the probes
        try:
            entries = np.linalg.solve(vectors, B.astype(np.complex128))
        except np.linalg.LinAlgError:  # one of them has no basis of eigenvectors
            entries = np.full(B.shape, np.nan, dtype=np.complex128)
        leaving = C @ vectors
        for i in range(out.shape[2]):
            for j in range(out.shape[3]):
                residues = leaving[:, i] * entries[..., j]
                out[..., i, j] = _partial_fractions(poles, residues, z) + D[:, i, j, None]
    probes = np.linspace(0, z.size - 1, _PROBES).astype(np.int64)
    pencils = z[probes, None, None] * np.eye(A.shape[1]) - A[:, None]
    states = np.linalg.solve(pencils, B[:, None].astype(np.complex128))
    direct = C[:, None] @ states + D[:, None]
    apart = np.max(np.abs(out[:, probes] - direct), axis=(1, 2, 3))
    agree = apart <= _AGREEMENT * np.max(np.abs(direct), axis=(1, 2, 3))
    for k in np.flatnonzero(~agree):
        out[k] = pointwise_response(StateSpace(A=A[k], B=B[k], C=C[k], D=D[k]), z)
    return out


def _partial_fractions(
    poles: ComplexArray, residues: ComplexArray, z: ComplexArray
) -> ComplexArray:
    """Sum ``residue / (z - pole)`` over the poles (k, s), at all points, (k, f).

    In real numbers, which is several times faster than a division of complex ones.
    """
    out = np.empty((len(poles), z.size), dtype=np.complex128)
    for start in range(0, len(poles), _IN_CACHE):
        rows = slice(start, start + _IN_CACHE)
        real, imaginary = np.zeros((2, len(poles[rows]), z.size))
        each = zip(poles[rows].T[..., None], residues[rows].T[..., None], strict=True)
        for pole, residue in each:
            x, y = z.real - pole.real, z.imag - pole.imag
            scale = 1 / (x * x + y * y)
            x *= scale
            y *= scale
            real += residue.real * x + residue.imag * y
            imaginary += residue.imag * x - residue.real * y
        out.real[rows], out.imag[rows] = real, imaginary
    return out
