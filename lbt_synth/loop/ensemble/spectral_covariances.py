"""Residuals that spectra and white noise leave in a stack of loops, by adaptive quadrature.

One set of panels serves all loops of a stack; it begins short around all their poles.
"""

from __future__ import annotations

import numpy as np

from lbt_synth.linear.quadrature import adaptive_integral, graded_edges
from lbt_synth.loop.ensemble.closed_loops import LoopStack
from lbt_synth.loop.ensemble.loop_ensemble import Turbulence
from lbt_synth.models import FrozenFlows, LoopHardware
from lbt_synth.models.spectra import breakpoints_below, spectrum_density
from lbt_synth.validation import ComplexArray, FloatArray


def spectral_covariances(
    stack: LoopStack,
    turbulence: list[tuple[Turbulence, tuple[int, ...]]],
    noise_nm: FloatArray,
    hardware: LoopHardware,
) -> FloatArray:
    """Covariances (k, 2, n, n) of the residual from turbulence, and from noise (k, q).

    ``turbulence`` pairs each spectrum with its modes. All is of the whole loop: the covariances of
    other parts are zero.
    """
    nyquist, part, n = hardware.frame_rate_hz / 2, stack.part, len(stack.part.influence)
    ways = [
        (i, j, modes)  # each spectrum with each mode of the part that has it in one of the copies
        for i, (_, modes) in enumerate(turbulence)
        for j in range(n)
        if np.any(np.isin(part.modes[:, j], modes))
    ]

    def integrand(frequency: FloatArray) -> FloatArray:
        """Return what each spectrum leaves on the way of each mode, and unit noise (f, k, ...)."""
        rejection, path, scale = stack.responses(np.exp(1j * np.pi * frequency / nyquist))
        weights = [_density(spectrum, frequency) * scale for spectrum, _ in turbulence]
        left = [_power(rejection[:, j]) * weights[i] for i, j, _ in ways]
        left += [_power(path[:, j]) * scale for j in range(path.shape[1])]
        return np.moveaxis(np.array(left), (3, 4), (0, 1))

    edges = [graded_edges(stack.poles.ravel()) * nyquist]
    edges += [breakpoints_below(spectrum, nyquist) for spectrum, _ in turbulence]
    found = adaptive_integral(integrand, np.unique(np.concatenate(edges)))
    out = np.zeros((stack.rows.size, 2, hardware.modes, hardware.modes))
    for own, inputs in zip(part.modes, part.measurements, strict=True):
        at = np.ix_(own, own)
        for place, (_, j, modes) in enumerate(ways):
            if own[j] in modes:
                out[:, 0, *at] += found[:, place]
        variance = noise_nm[:, inputs] ** 2 / nyquist
        out[:, 1, *at] = np.einsum("kjil,kj->kil", found[:, len(ways) :], variance)
    return out


def _power(transfer: ComplexArray) -> FloatArray:
    """Real part of ``T T*`` for transfers (n, f, k) from one input."""
    x, y = transfer.real, transfer.imag
    return np.asarray(x[:, None] * x + y[:, None] * y)


def _density(spectrum: Turbulence, frequency: FloatArray) -> FloatArray:
    """Return the spectrum of each loop (f, k), or that of all (f, 1)."""
    if isinstance(spectrum, FrozenFlows):
        shapes, which, factor = spectrum.factored_psd(frequency)
        return shapes.T[:, which] * factor
    return spectrum_density(spectrum, frequency)[:, None]
