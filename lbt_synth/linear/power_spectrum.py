"""Power spectra of series by Welch's method, without the import of ``scipy.signal``."""

from __future__ import annotations

import numpy as np

from lbt_synth.validation import FloatArray


def welch_spectrum(
    series: FloatArray, rate_hz: float, length: int, *, remove_mean: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Frequencies (f,) [Hz] and one-sided densities (..., f) of series (..., frames).

    The segments overlap by half, and a Hann window weighs them; ``remove_mean`` takes the mean out
    of each.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.linear.power_spectrum import welch_spectrum
    >>> white = np.random.default_rng(0).standard_normal(100_000)
    >>> frequency_hz, density = welch_spectrum(white, 1000.0, 64)
    >>> round(float(density[1:-1].mean()) * 500, 2)  # the variance
    1.0
    """
    window = np.hanning(length + 1)[:-1]
    segments = np.lib.stride_tricks.sliding_window_view(series, length, axis=-1)
    segments = segments[..., :: length - length // 2, :]
    if remove_mean:
        segments = segments - segments.mean(axis=-1, keepdims=True)
    power = np.abs(np.fft.rfft(window * segments)) ** 2 / (rate_hz * np.sum(window**2))
    power[..., 1 : (length + 1) // 2] *= 2  # but 0 and the Nyquist frequency
    frequency_hz = np.arange(power.shape[-1]) * rate_hz / length
    return frequency_hz, np.asarray(power.mean(axis=-2), dtype=np.float64)
