"""Roots and least values against closed forms, for functions that jump, are flat or infinite."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import jn_zeros, jv

from lbt_synth.linear.scalar_search import find_least, find_root

ROOTS = {
    "cube": (lambda x: x**3 - 2, 0.0, 2.0, 2 ** (1 / 3)),
    "steep": (lambda x: np.tanh(1e4 * (x - 0.3)), -1.0, 1.0, 0.3),
    "flat": (lambda x: (x - 0.5) ** 7, 0.0, 2.0, 0.5),
    "jump": (lambda x: -1.0 if x < 0.7 else x, 0.0, 1.0, 0.7),
    "falling": (lambda x: 1 - x, -3.0, 5.0, 1.0),
    "waves": (lambda x: jv(0, x), 2.0, 3.0, jn_zeros(0, 1)[0]),
    "at an end": (lambda x: x - 1, 1.0, 4.0, 1.0),
}


@pytest.mark.parametrize("name", ROOTS)
def test_roots(name):
    function, low, high, root = ROOTS[name]
    tried = []

    def counted(x):
        tried.append(x)
        return float(function(x))

    width = 1e-10
    found = find_root(counted, low, high, width=width)
    if name == "flat":  # all around its root it is zero to rounding
        assert abs(function(found)) < 1e-60
    else:
        assert found == pytest.approx(root, abs=width)
    assert len(tried) <= 2 + 3 * np.log2((high - low) / width)
    assert low <= min(tried) <= max(tried) <= high


def test_ends_of_one_sign_are_refused():
    with pytest.raises(ValueError, match="must differ"):
        find_root(lambda x: x**2 + 1, -1.0, 1.0, width=1e-9)


LEAST = {
    "inside": (lambda x: np.cosh(x - 0.3), -2.0, 3.0, 0.3),
    "infinite on one side": (lambda x: np.where(x > 0.4, np.inf, np.cosh(x)), -2.0, 3.0, 0.0),
    "at the lower end": (np.exp, 0.5, 4.0, 0.5),
    "at the upper end": (lambda x: -x, 0.5, 4.0, 4.0),
    "beside a wall": (lambda x: np.where(x > 0.25, np.inf, -x), 0.0, 1.0, 0.25),
    "narrow": (lambda x: -1 / (1e-4 + (x - 0.21) ** 2), 0.0, 1.0, 0.21),
    "constant": (np.zeros_like, 0.0, 1.0, None),
}


@pytest.mark.parametrize("name", LEAST)
def test_least_values(name):
    function, low, high, place = LEAST[name]
    width = 1e-7
    found, value = find_least(function, low, high, width=width)
    assert low <= found <= high
    if place is not None:
        assert found == pytest.approx(place, abs=2 * width)
    own = float(function(np.array([found]))[0])
    assert value == pytest.approx(own, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    "function",
    [lambda x: 1e-200 * (x + 1), lambda x: float("nan"), lambda x: x if x in (-1, 1) else np.nan],
)
def test_a_root_that_is_not_bracketed_is_refused(function):
    with pytest.raises(ValueError, match="must differ|has no value"):
        find_root(function, -1.0 if function(-1.0) == -1 else 0.0, 1.0, width=1e-9)


def test_values_of_any_size_have_a_root():
    def function(x):
        return -1e-170 if x < 0.2 else (2e-170 if x > 0.9 else 1.0)

    assert find_root(function, 0.0, 1.0, width=1e-9) == pytest.approx(0.2, abs=1e-9)
