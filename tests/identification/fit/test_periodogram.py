"""Periodograms of a loop: density, leakage, gaps, quadratic in the gain."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lbt_synth.identification.fit.periodogram import LoopPeriodogram, loop_periodogram

RATE = 1000.0


def periodogram_of(series: np.ndarray) -> LoopPeriodogram:
    return loop_periodogram(series, None, frame_rate_hz=RATE, stretches=[(0, series.size)])


def test_periodogram_of_white_noise_is_its_density_and_leaks_nothing_of_turbulence() -> None:
    rng = np.random.default_rng(1)
    white = 3 * rng.standard_normal(20_000)
    data, density = periodogram_of(white), 2 * 9 / RATE
    assert np.mean(data.power(1.0)) == pytest.approx(density, rel=0.02)
    # a random walk a thousand times larger at low frequencies leaves the noise as it is
    leaking = periodogram_of(white + np.cumsum(rng.standard_normal(white.size)) * 2)
    walk_density = 2 * 4 / RATE / (4 * np.sin(np.pi * data.frequency_hz / RATE) ** 2)
    excess = leaking.power(1.0) / (density + walk_density)
    assert np.mean(excess[data.frequency_hz > 300]) == pytest.approx(1, rel=0.04)


@given(gain=st.floats(0.1, 3), cut=st.integers(2000, 6000))
@settings(max_examples=10, deadline=None)
def test_periodogram_is_quadratic_in_the_gain(gain: float, cut: int) -> None:
    y, c = np.random.default_rng(cut).standard_normal((2, 8000))
    options = {"frame_rate_hz": RATE, "stretches": [(0, cut), (cut + 100, 8000)]}
    whole = loop_periodogram(y + gain * c, None, **options).power(1.0)
    assert loop_periodogram(y, c, **options).power(gain) == pytest.approx(
        whole, rel=1e-9, abs=1e-12
    )


def test_a_gap_shortens_the_segments_and_keeps_most_frames() -> None:
    y = np.random.default_rng(0).standard_normal(30_000)
    y[9990:10_010] = 1e6  # what a gap holds is never used
    data = loop_periodogram(y, None, frame_rate_hz=RATE, stretches=[(0, 9990), (10_010, 30_000)])
    assert np.mean(data.power(1.0)) == pytest.approx(2 / RATE, rel=0.03)
    assert 0.8 * 15_000 < np.sum(data.count) < 15_000


def test_what_lies_between_two_axes_at_any_gains() -> None:
    rng = np.random.default_rng(3)
    y, c = np.cumsum(rng.standard_normal((2, 3000, 2)), axis=1)
    make = partial(loop_periodogram, frame_rate_hz=500.0, stretches=[(0, 1400), (1410, 3000)])
    gains, data = np.array([0.7, 1.3]), make(y, c)
    for i in range(2):
        assert data.row(i).power(0.6) == pytest.approx(make(y[:, i], c[:, i]).power(0.6))
    z, matrix = y + gains * c, data.matrix(gains)
    one, other, both = (make(series, None).measured for series in (*z.T, z.sum(axis=1)))
    between = (both - one - other) / 2
    expected = np.array([[one, between], [between, other]])
    assert matrix == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.max(both))
