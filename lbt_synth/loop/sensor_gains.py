"""One controller at many sensor gains: responses and turbulence residuals at once.

With the loop transfer ``g G`` at sensor gain g, the rejection is ``S_g = (I + g G)^-1``. From
that of a stable loop, at gain h, the others follow without G, which may be infinite::

    S_g = M^-1 S_h,    M = (1 - r) S_h + r I,    r = g / h
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lbt_synth.loop.closed_loop import ClosedLoop
from lbt_synth.models.truth import Spectrum, breakpoints_below
from lbt_synth.quadrature import adaptive_integral
from lbt_synth.validation import ComplexArray, FloatArray

_NARROWEST = 1e-6  # width of a pole that panels are fitted to, as a part of Nyquist
_PANEL = 2.0  # length of a panel over its distance from a pole, or over the pole's width
_ORDER = 10


def rejections(
    reference: ClosedLoop, sensor_gains: FloatArray, frequency_hz: FloatArray
) -> ComplexArray:
    """Transfer from the total phase to the residual at sensor gains and frequencies.

    Parameters
    ----------
    reference : ClosedLoop
        A stable loop of one or two modes, at any sensor gain.
    sensor_gains : (g,) ndarray
        Sensor gains.
    frequency_hz : (f,) ndarray
        Frequencies [Hz].

    Returns
    -------
    (f, g, n, n) complex ndarray
        The rejections.

    Examples
    --------
    >>> import lbt_synth as lbt, numpy as np
    >>> from lbt_synth.loop.sensor_gains import rejections
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> lazy = lbt.integrator(path, gain=0.5).controller
    >>> one = lbt.close_loop(path, lazy)
    >>> other = lbt.close_loop(path, lazy, sensor_gain=0.5)
    >>> found = rejections(one, np.array([0.5]), np.array([20.0]))[:, 0]
    >>> bool(np.allclose(found, other.sensitivity([20.0]), rtol=1e-12))
    True
    """
    S = reference.sensitivity(frequency_hz)[:, None]
    ratio = (sensor_gains / reference.sensor_gain)[None, :]
    rest = 1 - ratio
    if S.shape[-1] == 1:
        return np.asarray(S / (rest * S[..., 0, 0] + ratio)[..., None, None])
    a, b, c, d = (S[..., i, j] for i in (0, 1) for j in (0, 1))
    # two modes: the adjugate of M times S is (1 - r) det(S) I + r S
    determinant = (rest * a + ratio) * (rest * d + ratio) - rest**2 * (b * c)
    shared, scale = rest * (a * d - b * c) / determinant, ratio / determinant
    out = np.empty((*determinant.shape, 2, 2), dtype=np.complex128)
    out[..., 0, 0], out[..., 0, 1] = scale * a + shared, scale * b
    out[..., 1, 0], out[..., 1, 1] = scale * c, scale * d + shared
    return out


def spectrum_covariances(
    reference: ClosedLoop,
    sensor_gains: FloatArray,
    poles: ComplexArray,
    spectrum: Spectrum,
    modes: Sequence[int],
) -> FloatArray:
    """Covariance of the residual that a spectrum leaves, at each of many sensor gains.

    Parameters
    ----------
    reference : ClosedLoop
        A stable loop of one or two modes, at any sensor gain.
    sensor_gains : (g,) ndarray
        Sensor gains at which the loop is stable.
    poles : (g, states) complex ndarray
        Poles of these loops.
    spectrum : Spectrum
        Spectrum of each of the ``modes``, which are independent.
    modes : sequence of int
        The modes that have it.

    Returns
    -------
    (g, n, n) ndarray
        Covariances [nm^2], from one set of frequencies that is fine enough for all.
    """

    def density(frequency: FloatArray) -> FloatArray:
        whole = rejections(reference, sensor_gains, frequency)
        S = np.take(whole, modes, axis=-1)
        # S S* by entries, which for one or two modes is faster than products of matrices
        power = np.empty(whole.shape)
        for i in range(reference.hardware.modes):
            for j in range(i + 1):
                product = S[..., i, :].real * S[..., j, :].real
                product += S[..., i, :].imag * S[..., j, :].imag
                power[..., i, j] = power[..., j, i] = product.sum(axis=-1)
        return np.asarray(spectrum.psd(frequency)[:, None, None, None] * power)

    nyquist = reference.hardware.frame_rate_hz / 2
    edges = [graded_edges(poles.ravel()) * nyquist, breakpoints_below(spectrum, nyquist)]
    return adaptive_integral(density, np.unique(np.concatenate(edges)), order=_ORDER)


def graded_edges(poles: ComplexArray) -> FloatArray:
    """Panels of (0, 1), in parts of Nyquist, that are short where a pole is near.

    A panel is halved while it is longer than twice its distance from a pole, or than twice
    the width of a pole that it holds.
    """
    upper = poles[poles.imag >= 0]
    centre = np.abs(np.angle(upper)) / np.pi
    width = np.maximum(1 - np.abs(upper), np.pi * _NARROWEST) / np.pi
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
