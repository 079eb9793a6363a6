"""Tests of whiteness of the innovations of a fitted spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.identification.fit.periodogram import LoopPeriodogram
from lbt_synth.validation import FloatArray, frozen_copy

LAGS = 100
_LOWEST = 3  # bins in which the ends of the taper show


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Whiteness:
    """Tests of the innovations, the prediction errors of the fitted model.

    Their spectrum is the ratio of periodogram to model.

    Attributes
    ----------
    deviation : float
        Largest distance of the cumulative periodogram of the innovations from the diagonal, as
        a part of their power.
    p_value : float
        Probability of a larger one if the innovations were white (M. S. Bartlett, An
        Introduction to Stochastic Processes, 1955; Kolmogorov's distribution).
    autocorrelation : (lags,) ndarray
        From lag 1.
    correlation_p_value : float
        Of Box and Pierce's sum of squares over these lags (doi:10.1080/01621459.1970.10481180).
    frequency_hz, cumulative : (f,) ndarray
        The cumulative periodogram, from 0 to 1.
    effective : float
        Number of independent values.
    """

    deviation: float
    p_value: float
    autocorrelation: FloatArray
    correlation_p_value: float
    frequency_hz: FloatArray
    cumulative: FloatArray
    effective: float

    @property
    def white(self) -> bool:
        """Whether neither test refuses whiteness at 1 %."""
        return self.p_value > 0.01 and self.correlation_p_value > 0.01


def whiteness(data: LoopPeriodogram, power: FloatArray, model: FloatArray) -> Whiteness:
    """Test whether power and model (f,) differ as white innovations do."""
    from scipy.stats import chi2, kstwobign

    ratio = power / model
    effective = float(np.sum(data.count))
    cumulative = np.cumsum(ratio) / np.sum(ratio)
    deviation = float(np.max(np.abs(cumulative - np.arange(1, ratio.size + 1) / ratio.size)))
    # a periodogram of n frames has n / 2 values; bins count as they are independent
    size = 2 * (ratio.size + 1)
    whole = data.frequency_hz.size / data.frequency_hz[-1] * data.frame_rate_hz / 2
    correlation, p_value = np.zeros(0), float("nan")
    if ratio.size > 0.95 * whole:  # up to the Nyquist frequency
        lags = min(LAGS, ratio.size // 16)
        filled = np.zeros(size // 2 + 1)  # from 0 to the Nyquist frequency
        filled[1:-1] = ratio - np.mean(ratio[_LOWEST:])
        filled[: 1 + _LOWEST] = 0
        correlation = np.fft.irfft(filled, size)[1 : lags + 1] * size / (2 * np.sum(ratio))
        p_value = float(chi2.sf(2 * effective * float(np.sum(correlation**2)), lags))
    return Whiteness(
        deviation=deviation,
        p_value=float(kstwobign.sf(deviation * np.sqrt(effective))),
        autocorrelation=frozen_copy(correlation),
        correlation_p_value=p_value,
        frequency_hz=data.frequency_hz,
        cumulative=frozen_copy(cumulative),
        effective=effective,
    )
