"""Periodograms of a loop: density, leakage, gaps, quadratic in the gain."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, trapezoid

from lbt_synth.identification.fit.periodogram import (
    TAPER,
    WIDE,
    cross_periodogram,
    log_smearing,
    loop_periodogram,
)


def taper(x: float) -> float:
    """Return the taper at a part of its length, by its definition."""
    edge = min(x, 1 - x)
    if edge < 0:
        return 0.0
    return 1.0 if edge >= TAPER / 2 else 0.5 * (1 - math.cos(2 * math.pi * edge / TAPER))


@cache
def correlations() -> tuple[np.ndarray, np.ndarray]:
    """Return lags and the autocorrelation of the taper at them."""
    t = np.linspace(0, 1, 1201)
    products = [
        quad(lambda x, lag=lag: taper(x) * taper(x + lag), 0, 1 - lag, limit=400)[0] for lag in t
    ]
    return t, np.array(products) / products[0]


@pytest.mark.parametrize(("width", "distance"), [(0.02, 0.4), (0.3, 1.3), (2.0, 0.0), (8.0, 5.0)])
def test_smearing_is_the_integral_that_defines_it(width: float, distance: float) -> None:
    t, r = correlations()
    kernel = r * np.exp(-2 * np.pi * width * t) * np.cos(2 * np.pi * distance * t)
    smeared = 2 * trapezoid(kernel, t)
    line = width / np.pi / (width**2 + distance**2)
    found = log_smearing(width, np.array([distance]))[0][0]
    assert found == pytest.approx(np.log(smeared / line), abs=5e-3)


@given(width=st.floats(1e-8, 25), distance=st.floats(0.02, 390))
@settings(max_examples=60, deadline=None)
def test_derivatives_of_the_smearing(width: float, distance: float) -> None:
    d = np.array([-distance, distance])
    _, by_width, by_distance = log_smearing(width, d)
    h = 1e-6
    numeric = (log_smearing(width * np.exp(h), d)[0] - log_smearing(width * np.exp(-h), d)[0]) / (
        2 * h
    )
    assert by_width == pytest.approx(numeric, abs=1e-4)
    numeric = (log_smearing(width, d + h)[0] - log_smearing(width, d - h)[0]) / (2 * h)
    # the cubics of neighbours meet with the same slope, but not with the same bend
    assert by_distance == pytest.approx(numeric, rel=1e-3, abs=2e-2)
    assert by_distance[0] == pytest.approx(-by_distance[1])


def test_wide_lines_are_as_they_are() -> None:
    value, _, _ = log_smearing(WIDE, np.linspace(-100, 100, 201))
    assert np.max(np.abs(value)) < 0.02


@pytest.mark.parametrize("frequency", [20.0, 123.4567])
def test_periodogram_of_a_sinusoid_is_the_taper(frequency: float) -> None:
    n, rate, rms = 48_000, 800.0, 100.0
    k = np.arange(n)
    y = rms * np.sqrt(2) * np.cos(2 * np.pi * frequency * k / rate + 0.3)
    data = loop_periodogram(y, None, frame_rate_hz=rate, stretches=[(0, n)])
    assert data.duration_s is not None
    d = (data.frequency_hz - frequency) * data.duration_s
    width = 1e-8
    for low, high in ((0, 1.5), (1.5, 4), (4, 10), (10, 20), (20, 40)):
        inside = (np.abs(d) >= low) & (np.abs(d) < high)
        line = width / np.pi / (width**2 + d[inside] ** 2)
        model = line * np.exp(log_smearing(width, d[inside])[0]) * rms**2 * data.duration_s
        assert np.mean(data.power(1.0)[inside]) == pytest.approx(np.mean(model), rel=0.06)


RATE = 1000.0


def test_periodogram_of_white_noise_is_its_density_and_leaks_nothing_of_turbulence() -> None:
    rng = np.random.default_rng(1)
    white = 3 * rng.standard_normal(20_000)
    data = loop_periodogram(white, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    density = 2 * 9 / RATE
    assert np.mean(data.power(1.0)) == pytest.approx(density, rel=0.02)
    # a random walk a thousand times larger at low frequencies leaves the noise as it is
    walk = np.cumsum(rng.standard_normal(white.size)) * 2
    leaking = loop_periodogram(white + walk, None, frame_rate_hz=RATE, stretches=[(0, white.size)])
    walk_density = 2 * 4 / RATE / (4 * np.sin(np.pi * data.frequency_hz / RATE) ** 2)
    high = data.frequency_hz > 300
    excess = np.mean(leaking.power(1.0)[high] / (density + walk_density[high]))
    assert excess == pytest.approx(1, rel=0.04)


@given(gain=st.floats(0.1, 3), cut=st.integers(2000, 6000))
@settings(max_examples=10, deadline=None)
def test_periodogram_is_quadratic_in_the_gain(gain: float, cut: int) -> None:
    rng = np.random.default_rng(cut)
    y, c = rng.standard_normal((2, 8000))
    pieces = [(0, cut), (cut + 100, 8000)]
    parts = loop_periodogram(y, c, frame_rate_hz=RATE, stretches=pieces)
    whole = loop_periodogram(y + gain * c, None, frame_rate_hz=RATE, stretches=pieces)
    assert parts.power(gain) == pytest.approx(whole.power(1.0), rel=1e-9, abs=1e-12)


def test_a_gap_shortens_the_segments_and_keeps_most_frames() -> None:
    rng = np.random.default_rng(0)
    y = rng.standard_normal(30_000)
    y[9990:10_010] = 1e6  # what a gap holds is never used
    data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, 9990), (10_010, 30_000)])
    assert np.mean(data.power(1.0)) == pytest.approx(2 / RATE, rel=0.03)
    assert 0.8 * 15_000 < np.sum(data.count) < 15_000


def test_the_cross_periodogram_belongs_to_those_of_the_axes() -> None:
    rng = np.random.default_rng(3)
    x, y = np.cumsum(rng.standard_normal((2, 3000)), axis=1)
    options = {"frame_rate_hz": 500.0, "stretches": [(0, 1400), (1410, 3000)]}
    one, other, both = (
        loop_periodogram(series, None, **options).measured for series in (x, y, x + y)
    )
    crossed = cross_periodogram(x, y, **options)
    assert one + other + 2 * crossed.real == pytest.approx(both, rel=1e-9)
    assert cross_periodogram(y, x, **options) == pytest.approx(crossed.conj())
    assert cross_periodogram(x, x, **options).real == pytest.approx(one, rel=1e-9)
    assert np.all(np.abs(crossed) ** 2 < 1.000001 * one * other)
