"""The scatter of mean products of two Gaussian series."""

from __future__ import annotations

import numpy as np
from scipy.fft import rfft

from lbt_synth.identification.stretches import Stretches
from lbt_synth.validation import ComplexArray, FloatArray


def mean_covariance(one: FloatArray, other: FloatArray, stretches: Stretches) -> FloatArray:
    """Return the covariance over the axes of mean products of two Gaussian series, (n, n).

    Over K frames it is ``2 / K`` times the sum of the squared cross-covariances over all lags
    (M. S. Bartlett, J. Roy. Stat. Soc. Suppl. 8, 27 (1946), doi:10.2307/2983611). A periodogram I
    has ``E I^2 = 2 S^2``: no spectrum needs to be smoothed.

    ``cov(x_i y_i, x_j y_j)`` over all lags is the mean over the frequencies of ``S(x_i, x_j)
    conj S(y_i, y_j) + S(x_i, y_j) conj S(y_i, x_j)``. On the diagonal the product of the two
    periodograms has that mean for x = y, and at least that otherwise; off it, the two factors
    are taken at neighbouring frequencies, which are independent.
    """
    frames, n = one.shape
    total, start = np.zeros((n, n)), 0
    for begin, end in stretches:
        length = end - begin
        x, y = (rfft(series[start : start + length], axis=0) for series in (one, other))
        weight = np.full(len(x), 2.0)  # a frequency and its negative
        weight[0] = 1.0
        weight[-1] = 2.0 if length % 2 else 1.0
        weight /= length**2
        part = _products(x, x) * np.roll(_products(y, y).conj(), 1, axis=0)
        part += _products(x, y) * np.roll(_products(y, x).conj(), 1, axis=0)
        lower = np.tril(np.tensordot(weight, part.real, 1), -1)
        total += lower + lower.T + np.diag(weight @ (np.abs(x) ** 2 * np.abs(y) ** 2))
        start += length
    total /= frames**2
    # a covariance is at most the product of the deviations
    most = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    return np.asarray(np.clip(total, -most, most))


def _products(x: ComplexArray, y: ComplexArray) -> ComplexArray:
    """Return ``x_i conj(y_j)`` at each frequency, (f, n, n)."""
    return x[:, :, None] * y.conj()[:, None, :]
