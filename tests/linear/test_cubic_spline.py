"""The spline against scipy's, between its knots and beyond them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from lbt_synth.linear.cubic_spline import cubic_spline


def test_splines_of_several_curves_are_those_of_each():
    rng = np.random.default_rng(1)
    x, y = np.cumsum(rng.random(20) + 0.05), rng.standard_normal((20, 3, 2))
    own, other = cubic_spline(x, y).coefficients, CubicSpline(x, y).c
    np.testing.assert_allclose(own, other, atol=1e-9 * np.max(np.abs(other)))


@pytest.mark.parametrize("size", [4, 5, 60])
def test_spline_is_that_of_scipy(size):
    rng = np.random.default_rng(size)
    x, y = np.cumsum(rng.random(size) + 0.05), rng.standard_normal(size)
    own, other = cubic_spline(x, y), CubicSpline(x, y)
    at = np.concatenate([x, np.linspace(x[0] - 0.1, x[-1] + 0.1, 777)])
    np.testing.assert_allclose(own(at), other(at), rtol=1e-9, atol=1e-9 * np.max(np.abs(other(at))))
    scale = np.max(np.abs(other.c), axis=1, keepdims=True)
    np.testing.assert_allclose(own.coefficients / scale, other.c / scale, atol=1e-9)


def test_cubes_are_exact():
    x = np.array([-1.0, 0.5, 0.7, 3.0, 4.0, 4.1])
    at = np.linspace(-2, 5, 99)
    np.testing.assert_allclose(
        cubic_spline(x, 2 * x**3 - x + 4)(at), 2 * at**3 - at + 4, atol=1e-11
    )


def test_three_points_are_too_few():
    with pytest.raises(ValueError, match="four points"):
        cubic_spline(np.arange(3.0), np.zeros(3))
