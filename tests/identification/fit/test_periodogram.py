"""Periodograms of a loop: density, leakage, gaps, quadratic in the gain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lbt_synth.identification.fit.periodogram import loop_periodogram

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


def test_what_lies_between_two_axes_at_any_gains() -> None:
    rng = np.random.default_rng(3)
    y, c = np.cumsum(rng.standard_normal((2, 3000, 2)), axis=1)
    options = {"frame_rate_hz": 500.0, "stretches": [(0, 1400), (1410, 3000)]}
    gains = np.array([0.7, 1.3])
    data = loop_periodogram(y, c, **options)
    for i in range(2):
        alone = loop_periodogram(y[:, i], c[:, i], **options)
        assert data.row(i).power(0.6) == pytest.approx(alone.power(0.6))
    matrix = data.matrix(gains)
    z = y + gains * c
    one, other, both = (
        loop_periodogram(series, None, **options).measured for series in (*z.T, z.sum(axis=1))
    )
    assert matrix[0, 0] == pytest.approx(one, rel=1e-9)
    assert matrix[1, 1] == pytest.approx(other, rel=1e-9)
    assert one + other + 2 * matrix[0, 1] == pytest.approx(both, rel=1e-9)
    assert matrix[1, 0] == pytest.approx(matrix[0, 1])
