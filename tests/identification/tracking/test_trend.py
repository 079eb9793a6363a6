"""Trends of line frequencies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lbt_synth.identification.tracking.trend import extrapolate


# The trend.
def test_a_straight_line_is_continued():
    t = np.arange(6.0)
    frequency, slope, error = extrapolate(t, 17 + 0.1 * t, 7.5)
    assert (frequency, slope) == (pytest.approx(17.75), pytest.approx(0.1))
    assert error < 1e-12
    assert extrapolate(t, np.full(6, 17.0), 7.5)[0] == 17
    for few in (1, 3):
        frequency, slope, _ = extrapolate(t[:few], 17 + 0.1 * t[:few], 7.5)
        assert frequency == 17 + 0.1 * t[few - 1]
        assert np.isnan(slope)


@given(shift=st.floats(-5, 5), scale=st.floats(0.5, 2), seed=st.integers(0, 50))
def test_the_trend_knows_no_origin_of_time(shift, scale, seed):
    t = np.arange(8.0)
    f = 20 + 0.05 * t + 0.05 * np.random.default_rng(seed).standard_normal(8)
    plain = extrapolate(t, f, 10.0, overlap=2)
    moved = extrapolate(t + shift, 3 + f, 10.0 + shift, overlap=2)
    assert moved == pytest.approx((plain[0] + 3, plain[1], plain[2]), rel=1e-7, abs=1e-9)
    slower = extrapolate(scale * t, f, scale * 10.0, overlap=2)
    assert slower == pytest.approx((plain[0], plain[1] / scale, plain[2] / scale), rel=1e-7)


def test_an_outlier_is_no_trend_but_two_are_another():
    t = np.arange(8.0)
    f = 17 + 0.1 * t + 0.002 * np.array([1, -1, 1, 1, -1, -1, 1, -1])
    for wrong in (3, 7):
        spoilt = f.copy()
        spoilt[wrong] += 1.5
        assert extrapolate(t, spoilt, 9.0)[0] == pytest.approx(17.9, abs=0.02)
    spoilt[6:] = 20.0
    frequency, slope, _ = extrapolate(t, spoilt, 9.0)
    assert frequency == 20
    assert np.isnan(slope)


def test_the_error_of_the_slope_is_that_of_least_squares_and_limits_it():
    rng = np.random.default_rng(4)
    t = np.arange(8.0)
    f = 20 + 0.3 * rng.standard_normal(8)
    frequency, slope, error = extrapolate(t, f, 12.0)
    fit, covariance = np.polyfit(t, f, 1, cov=True)
    assert slope == pytest.approx(fit[0])
    assert error == pytest.approx(np.sqrt(covariance[0, 0]))
    assert extrapolate(t, f, 12.0, overlap=4)[2] == pytest.approx(2 * error)
    weight = slope**2 / (slope**2 + error**2)
    expected = f[-1] + weight * (np.polyval(fit, 12.0) - f[-1])
    assert frequency == pytest.approx(expected)
    assert weight < 0.9  # the test has teeth: noise has no significant slope
