"""Peaks of a periodogram, compared with scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import find_peaks

from lbt_synth.identification.commands.spectral_peaks import (
    find_spectral_peaks,
    find_tops,
    smooth_neighbours,
    surrounding_median,
)


@pytest.mark.parametrize("seed", range(5))
def test_filters_and_tops_are_those_of_scipy(seed):
    values = np.random.default_rng(seed).normal(size=700)
    np.testing.assert_allclose(
        smooth_neighbours(values), uniform_filter1d(values, 3, mode="nearest"), atol=1e-13
    )
    np.testing.assert_array_equal(
        surrounding_median(values, 81), median_filter(values, size=81, mode="nearest")
    )
    tops, _ = find_peaks(values, height=0.5, distance=4)
    own = find_tops(values, least=0.5, apart=4)
    np.testing.assert_array_equal(np.sort(own), tops)
    assert np.all(np.diff(values[own]) <= 0)


def test_peaks_are_the_lines_of_a_spectrum():
    rng = np.random.default_rng(1)
    frequency = np.arange(1, 2000) / 6
    lines = [40 / (1 + (frequency - f) ** 2) for f in (60, 200)]
    power = 1e3 / frequency**2 + 1 + lines[0] + lines[1]
    scatter = rng.gamma(8.0, 1 / 8.0, frequency.size)
    is_peak, places, width = find_spectral_peaks(frequency, power * scatter)
    assert [min(abs(places - f)) < 1 for f in (60, 200)] == [True, True]
    assert is_peak[np.searchsorted(frequency, [60, 200])].all()
    assert width.shape == places.shape
    assert np.all(width > 0)
    assert np.mean(is_peak) < 0.2
