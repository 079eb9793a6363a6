"""Residuals that spectra and white noise leave in the loops of one subloop, by quadrature.

One set of frequencies serves all loops of a batch. It is refined around all their poles, which
are known, so that a rule of fixed order is enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.linear import StateSpace
from lbt_synth.linear.quadrature import gauss_panels, panel_rule
from lbt_synth.linear.state_space import schur_response
from lbt_synth.loop.ensemble.batched_loops import DelayGroup
from lbt_synth.loop.ensemble.frequency_responses import batched_response
from lbt_synth.loop.ensemble.loop_ensemble import Turbulence
from lbt_synth.loop.ensemble.panels import graded_edges
from lbt_synth.loop.ensemble.subloops import Subloop
from lbt_synth.models import ARModel, Atmosphere, FrozenFlows, SumSpectrum, TabulatedSpectrum
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.models.turbulence.atmosphere import LOWEST
from lbt_synth.validation import ComplexArray, FloatArray

ORDER = 10  # nodes per panel
_RIPPLES = np.concatenate([np.arange(1, 3, 0.5), np.arange(3, 26, 1.25), np.geomspace(26, 60, 8)])
_ALIKE, _STEP = 3.5, 0.08  # winds of a larger ratio share panels that widen with frequency
_FLAT = 0.02  # a spectrum is flat below this fraction of the frequency V / L0
_SETTLED, _HALVINGS = 1e-8, 20  # of the panels of a spectrum of unknown shape
_COVERED = 1e-6  # fraction of Nyquist above which there are geometric panels in any case


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SampledResponses:
    """Responses of a subloop's elements at the f frequencies of a quadrature."""

    frequency_hz: FloatArray
    weight_hz: FloatArray
    delay: ComplexArray  # ``z^-1``
    first: ComplexArray  # of the group's two mirrors
    second: ComplexArray
    controller: ComplexArray  # (f, m, q), or (k, f, m, q) with one per loop


def _sample_responses(
    subloop: Subloop,
    group: DelayGroup,
    poles: ComplexArray,
    spectra: list[Turbulence],
    frame_rate_hz: float,
) -> _SampledResponses:
    """Choose frequencies for the poles of a batch of loops, and evaluate a subloop there."""
    nyquist = frame_rate_hz / 2
    edges = [graded_edges(poles.ravel()) * nyquist]
    edges += [_breakpoints(spectrum, nyquist) for spectrum in spectra]
    frequency, weight = gauss_panels(np.unique(np.concatenate(edges)), ORDER)
    z = np.exp(1j * np.pi * frequency / nyquist)
    ends = (group.first,) if group.first is group.second else (group.first, group.second)
    mirrors = [_response(m.A, m.B[:, None], m.C[None], np.array([[m.D]]), z) for m in ends]
    A, B, C, D = subloop.controllers(group.rows)
    if subloop.is_shared:
        controller = _response(A[0], B[0], C[0], D[0], z)
    else:
        controller = batched_response(A, B, C, D, z)
    return _SampledResponses(
        frequency_hz=frequency,
        weight_hz=weight,
        delay=1 / z,
        first=mirrors[0][:, 0, 0],
        second=mirrors[-1][:, 0, 0],
        controller=controller,
    )


def _response(
    A: FloatArray, B: FloatArray, C: FloatArray, D: FloatArray, z: ComplexArray
) -> ComplexArray:
    """Transfer matrices (f, m, q) of one system, which may have no state."""
    if len(A) == 0:
        return np.broadcast_to(D.astype(np.complex128), (z.size, *D.shape))
    return schur_response(StateSpace(A=A, B=B, C=C, D=D).balanced(), z)


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
    # the tilt filter ripples with the inverse of the time that the wind takes over the pupil
    if fast > _ALIKE * slow:
        ripples = np.geomspace(slow, fast * _RIPPLES[-1], int(np.log(60 * fast / slow) / _STEP) + 2)
    else:
        reach = np.geomspace(slow * _RIPPLES[-1], fast * _RIPPLES[-1], 8)
        ripples = np.concatenate([slow * _RIPPLES, reach])
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


def spectral_covariances(
    subloop: Subloop,
    group: DelayGroup,
    poles: ComplexArray,
    sensor_gains: FloatArray,
    turbulence: list[tuple[Turbulence, list[int]]],
    noise_nm: FloatArray,
    frame_rate_hz: float,
) -> tuple[FloatArray, FloatArray]:
    """Covariances (k, n, n) of the residual from turbulence, and from noise (k, q).

    ``turbulence`` pairs each spectrum with its modes of the subloop.
    """
    is_scalar = subloop.sensor.shape == subloop.influence.shape == (1, 1)
    evaluate = _scalar_covariances if is_scalar else _matrix_covariances
    spectra = [spectrum for spectrum, _ in turbulence]
    samples = _sample_responses(subloop, group, poles, spectra, frame_rate_hz)
    densities = [(_weighted_density(spectrum, samples), modes) for spectrum, modes in turbulence]
    white = 2 / frame_rate_hz * samples.weight_hz
    return evaluate(subloop, group, sensor_gains, samples, densities, noise_nm, white)


def _weighted_density(spectrum: Turbulence, samples: _SampledResponses) -> FloatArray:
    """Spectrum times the weights, (f,) or (k, f)."""
    density = spectrum.psd(samples.frequency_hz)
    return np.asarray(density[0] if len(density) == 1 else density) * samples.weight_hz


def _scalar_covariances(
    subloop: Subloop,
    group: DelayGroup,
    gains: FloatArray,
    samples: _SampledResponses,
    densities: list[tuple[FloatArray, list[int]]],
    noise_nm: FloatArray,
    white: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """One mode, in real numbers: ``|S|^2 = 1 / |1 + g L|^2`` with the loop L at unit gain."""
    size = subloop.influence[0, 0] * subloop.sensor[0, 0]
    unit = size * samples.controller[..., 0, 0] * samples.delay
    first, second = unit * samples.first, unit * samples.second
    real, imaginary = first.real, first.imag
    if group.fraction.any():
        share = group.fraction[:, None]
        real = real + share * (second.real - real)
        imaginary = imaginary + share * (second.imag - imaginary)
    g = gains[:, None]
    # not 1 + 2 g Re L + g^2 |L|^2, which cancels next to instability
    rejection = 1 / ((1 + g * real) ** 2 + (g * imaginary) ** 2)
    square = (real**2 + imaginary**2) / subloop.sensor[0, 0] ** 2
    turbulence = np.zeros(len(gains))
    for density, _ in densities:  # each is of the one mode
        turbulence += _integrate(rejection, density)
    noise = noise_nm[:, 0] ** 2 * _integrate(rejection * square, white)
    return turbulence[:, None, None], noise[:, None, None]


def _integrate(values: FloatArray, density: FloatArray) -> FloatArray:
    """Sum over the frequencies (k, f), with one density (f,) or one per loop (k, f)."""
    if density.ndim == 1:
        return np.asarray(values @ density)
    return np.asarray(np.einsum("kf,kf->k", values, density))


def _matrix_covariances(
    subloop: Subloop,
    group: DelayGroup,
    gains: FloatArray,
    samples: _SampledResponses,
    densities: list[tuple[FloatArray, list[int]]],
    noise_nm: FloatArray,
    white: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Several modes, one loop at a time."""
    n = subloop.modes.size
    turbulence, noise = np.zeros((2, len(gains), n, n))
    for k, gain in enumerate(gains):
        share = group.fraction[k]
        mirror = (1 - share) * samples.first + share * samples.second
        controller = samples.controller if subloop.is_shared else samples.controller[k]
        path = subloop.influence @ (mirror[:, None, None] * controller)  # (f, n, q)
        loop = path @ (gain * subloop.sensor) * samples.delay[:, None, None]
        S = _inverses(np.eye(n) + loop)
        N = S @ (path * noise_nm[k])
        noise[k] = _gram(N, white)
        for density, modes in densities:
            turbulence[k] += _gram(S[..., modes], density if density.ndim == 1 else density[k])
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
