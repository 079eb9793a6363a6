"""Residuals that spectra and white noise leave in a stack of loops, by adaptive quadrature.

One set of panels serves all loops of a stack; it begins short around all their poles. What moves
within a frame is that of :mod:`lbt_synth.loop.budget`.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from lbt_synth.linear.quadrature import adaptive_integral, graded_edges, panel_rule
from lbt_synth.loop.ensemble.closed_loops import LoopStack
from lbt_synth.loop.ensemble.loop_ensemble import Turbulence
from lbt_synth.models import FrozenFlows, LoopHardware
from lbt_synth.models.ar_model import densities
from lbt_synth.models.spectra import breakpoints_below, spectrum_density
from lbt_synth.validation import ComplexArray, FloatArray, IntArray

_Way: TypeAlias = tuple[int, int, tuple[int, ...]]  # of a spectrum to a mode of a part
_WIDENINGS = 16  # panels beside a pole, each four times as long as the one before
_ORDER = 10  # of the rule on a panel; 6 leaves errors of 3e-6


def spectral_covariances(
    stack: LoopStack,
    turbulence: list[tuple[Turbulence, tuple[int, ...]]],
    noise_nm: FloatArray,
    hardware: LoopHardware,
    *,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, 3, n, n) of the residual from turbulence, from noise (k, q), and within.

    ``turbulence`` pairs each spectrum with its modes. All is of the whole loop: the covariances of
    other parts are zero. The third is of what moves within frames, zero if that does not count.
    """
    nyquist, part, n = hardware.frame_rate_hz / 2, stack.part, len(stack.part.influence)
    ways = [
        (i, j, modes)  # each spectrum with each mode of the part that has it in one of the copies
        for i, (_, modes) in enumerate(turbulence)
        for j in range(n)
        if np.any(np.isin(part.modes[:, j], modes))
    ]
    spectra = [spectrum for spectrum, _ in turbulence]
    plain = stack.holds_are_frames or not in_image

    def integrand(frequency: FloatArray) -> FloatArray:
        """Return what each spectrum leaves on the way of each mode, and unit noise (f, k, ...).

        First come all that the means leave; where holds are no frames, then all that moves within.
        """
        z = np.exp(1j * np.pi * frequency / nyquist)
        density = [_density(spectrum, frequency) for spectrum in spectra]
        if not plain:
            left = _of_pieces(stack, z, ways, density)
        else:
            share = np.sinc(frequency / nyquist / 2)[:, None] ** 2 if in_image else np.ones((1, 1))
            rejection, path, scale = stack.responses(z)
            weights = [one * share * scale for one in density]
            left = [_power(rejection[:, j]) * weights[i] for i, j, _ in ways]
            left += [_power(path[:, j]) * scale for j in range(path.shape[1])]
        return np.moveaxis(np.array(left), (3, 4), (0, 1))

    edges = [graded_edges(stack.poles.ravel()) * nyquist]
    edges += [breakpoints_below(spectrum, nyquist) for spectrum in spectra]
    panels = np.unique(np.concatenate(edges))
    single = stack.is_single and (in_image or stack.holds_are_frames)
    within = np.zeros((1, 0, n, n))
    if single:
        means = _of_single(stack, [spectra[i] for i, _, _ in ways], panels, nyquist, in_image)
    elif plain:
        means = adaptive_integral(integrand, panels)
    else:
        means, within = np.split(adaptive_integral(integrand, panels), 2, axis=1)
    if (single or plain) and in_image and ways:
        powers = [_power_within(spectrum, panels, nyquist) for spectrum in spectra]
        parts = [powers[i][:, None, None] * _unit(n, j)[..., 0, 0] for i, j, _ in ways]
        within = np.stack(np.broadcast_arrays(*parts), axis=1)
    out = np.zeros((stack.rows.size, 3, hardware.modes, hardware.modes))
    for own, inputs in zip(part.modes, part.measurements, strict=True):
        at = np.ix_(own, own)
        for place, (_, j, modes) in enumerate(ways):
            if own[j] in modes:
                out[:, 0, *at] += means[:, place]
                if within.shape[1]:
                    out[:, 2, *at] += within[:, place]
        variance = noise_nm[:, inputs] ** 2 / nyquist
        out[:, 1, *at] = np.einsum("kjil,kj->kil", means[:, len(ways) :], variance)
        if within.shape[1] > len(ways):
            out[:, 2, *at] += np.einsum("kjil,kj->kil", within[:, len(ways) :], variance)
    return out


def _of_single(
    stack: LoopStack,
    spectra: list[Turbulence],
    panels: FloatArray,
    nyquist_hz: float,
    in_image: bool,
) -> FloatArray:
    """Covariances (k, s + 1, 1, 1) of what spectra and unit noise leave of means over frames."""

    def integrand(frequency: FloatArray) -> FloatArray:
        phase, noise = stack.single_powers(np.exp(1j * np.pi * frequency / nyquist_hz))
        share = np.sinc(frequency / nyquist_hz / 2)[:, None] ** 2 if in_image else 1.0
        out = np.empty((len(phase), len(spectra) + 1, phase.shape[1]))
        for i, spectrum in enumerate(spectra):
            shapes, which, _ = _factored(spectrum, frequency)
            np.multiply((shapes * share)[:, which], phase, out=out[:, i])
        out[:, -1] = noise
        return out[..., None, None]

    means = np.moveaxis(adaptive_integral(integrand, panels), 0, 1)
    factors = [_factored(spectrum, panels[1:2])[2] for spectrum in spectra]
    for i, factor in enumerate(factors):
        means[:, i, 0, 0] *= factor
    return means


def _power_within(spectrum: Turbulence, panels: FloatArray, nyquist_hz: float) -> FloatArray:
    """Power of the spectrum of each loop that moves within frames [nm^2], (k,) or (1,)."""

    def integrand(frequency: FloatArray) -> FloatArray:
        rest = 1 - np.sinc(frequency / nyquist_hz / 2) ** 2
        return (_factored(spectrum, frequency)[0] * rest[:, None])[..., None, None]

    _, which, factor = _factored(spectrum, panels[1:2])
    return np.asarray(adaptive_integral(integrand, panels)[which, 0, 0] * factor)


def _of_pieces(
    stack: LoopStack, z: ComplexArray, ways: list[_Way], density: list[FloatArray]
) -> list[FloatArray]:
    """Return powers (n, n, f, k) on each way, of unit noise, and the same within a hold."""
    n, q = stack.part.sensor.shape[1], stack.part.sensor.shape[0]
    pieces, rest = stack.piece_responses(z)
    columns = [("phase", j) for _, j, _ in ways] + [("noise", j) for j in range(q)]
    mean = [np.zeros((n, *rest.shape), dtype=np.complex128) for _ in columns]
    power = [np.zeros((n, n, *rest.shape)) for _ in columns]
    for weight, phase, noise in pieces:
        for place, (kind, j) in enumerate(columns):
            response = (phase if kind == "phase" else noise)[:, j]
            mean[place] += weight * response
            power[place] += weight * _power(response)
    of_means = [_power(one) for one in mean]
    within = [one - other for one, other in zip(power, of_means, strict=True)]
    for place, (i, j, _) in enumerate(ways):
        of_means[place] = of_means[place] * density[i]
        within[place] = (within[place] + _unit(n, j) * rest) * density[i]
    return of_means + within


def process_covariances(
    reached: list[tuple[LoopStack, IntArray]],
    coefficients: FloatArray,
    driving_rms_nm: FloatArray,
    along: FloatArray,
    hardware: LoopHardware,
) -> FloatArray:
    """Covariances (k, 2, n, n) that processes of means over frames leave, of means and within.

    They are for loops in which commands do not hold for one exposure. The loops have processes of
    coefficients (k or 1, r) and directions ``along`` (k or 1, n), which reach the stacks.
    """
    rate, first = hardware.frame_rate_hz, reached[0][0]
    places = np.concatenate([modes for _, modes in reached])
    direction = np.broadcast_to(along[:, places], (first.rows.size, places.size)).T

    def integrand(frequency: FloatArray) -> FloatArray:
        z = np.exp(2j * np.pi * frequency / rate)
        density = densities(coefficients, driving_rms_nm, rate, frequency).T
        density = density / np.sinc(frequency / rate)[:, None] ** 2
        stacks = [stack.piece_responses(z) for stack, _ in reached]
        mean = np.zeros((places.size, frequency.size, first.rows.size), dtype=np.complex128)
        power = np.zeros((places.size, *mean.shape))
        for parts in zip(*(pieces for pieces, _ in stacks), strict=True):
            at, rows = 0, []
            for _, phase, _ in parts:
                n = len(phase)
                rows.append(np.einsum("ijfk,jk->ifk", phase, direction[at : at + n]))
                at += n
            response = np.concatenate(rows)
            mean += parts[0][0] * response
            power += parts[0][0] * _power(response)
        of_means = _power(mean)
        still = direction[:, None, None] * direction[None, :, None] * stacks[0][1]
        left = np.array([of_means, power - of_means + still]) * density
        return np.moveaxis(left, (3, 4), (0, 1))

    poles = [stack.poles.ravel() for stack, _ in reached]
    edges = graded_edges(np.concatenate([*poles, process_poles(coefficients).ravel()]))
    covariances = adaptive_integral(integrand, edges * rate / 2)
    out = np.zeros((first.rows.size, 2, hardware.modes, hardware.modes))
    out[:, :, places[:, None], places] = covariances
    return out


def process_poles(coefficients: FloatArray) -> ComplexArray:
    """Poles of processes, (k, r)."""
    k, order = coefficients.shape
    companion = np.zeros((k, order, order))
    companion[:, 0], companion[:, 1:, :-1] = coefficients, np.eye(order - 1)
    return np.linalg.eigvals(companion).astype(np.complex128)


def power_within_frames(
    coefficients: FloatArray, driving_rms_nm: FloatArray, frame_rate_hz: float
) -> FloatArray:
    """Power of processes of means over frames that moves within the frames [nm^2], (k,).

    It is the integral of ``S (1 / sinc^2 - 1)``, on panels of each process around its own poles.
    """
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


def _unit(n: int, mode: int) -> FloatArray:
    """Covariance of one mode alone, (n, n, 1, 1)."""
    out = np.zeros((n, n, 1, 1))
    out[mode, mode] = 1.0
    return out


def _power(transfer: ComplexArray) -> FloatArray:
    """Real part of ``T T*`` for transfers (n, f, k) from one input."""
    x, y = transfer.real, transfer.imag
    return np.asarray(x[:, None] * x + y[:, None] * y)


def _density(spectrum: Turbulence, frequency: FloatArray) -> FloatArray:
    """Return the spectrum of each loop (f, k), or that of all (f, 1)."""
    shapes, which, factor = _factored(spectrum, frequency)
    return shapes[:, which] * factor


def _factored(
    spectrum: Turbulence, frequency: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return the different shapes of a spectrum (f, u), and of each loop its shape and factor."""
    if isinstance(spectrum, FrozenFlows):
        shapes, which, factor = spectrum.factored_psd(frequency)
        return shapes.T, which, factor
    return spectrum_density(spectrum, frequency)[:, None], np.zeros(1, dtype=np.intp), np.ones(1)
