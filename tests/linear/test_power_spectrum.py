"""Welch's method against that of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import welch

from lbt_synth.linear.power_spectrum import welch_spectrum


@pytest.mark.parametrize("remove_mean", [False, True])
@pytest.mark.parametrize(("frames", "length"), [(64, 64), (500, 64), (500, 33), (95, 64)])
def test_it_is_that_of_scipy(frames, length, remove_mean):
    series = 3.0 + np.random.default_rng(frames).standard_normal((2, 3, frames))
    frequency_hz, density = welch_spectrum(series, 800.0, length, remove_mean=remove_mean)
    detrend = "constant" if remove_mean else False
    expected_hz, expected = welch(series, fs=800.0, nperseg=length, detrend=detrend)
    assert np.allclose(frequency_hz, expected_hz, rtol=1e-14)
    assert np.allclose(density, expected, rtol=1e-10, atol=1e-14)
