"""Rounding together against rounding one by one, and against a search of all neighbours."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lbt_synth.interop.dao.lattice_rounding import round_together


def misses(rounded, exact, sensitivity):
    return np.linalg.norm(sensitivity @ (rounded.astype(np.float64) - exact))


@pytest.mark.parametrize("seed", range(8))
def test_errors_cancel_where_they_count(seed):
    rng = np.random.default_rng(seed)
    exact = rng.standard_normal(12) * 10 ** rng.uniform(-2, 2, 12)
    sensitivity = (
        rng.standard_normal((30, 12))
        @ np.diag(10.0 ** -np.arange(12))
        @ rng.standard_normal((12, 12))
    )
    found = round_together(exact, sensitivity)
    assert found.dtype == np.float32
    alone = exact.astype(np.float32)
    assert misses(found, exact, sensitivity) < 0.1 * misses(alone, exact, sensitivity)


@pytest.mark.parametrize("seed", range(8))
def test_no_neighbour_is_much_better(seed):
    rng = np.random.default_rng(seed)
    exact = rng.uniform(1, 2, 4)
    sensitivity = rng.standard_normal((6, 4))
    step = np.spacing(np.float32(1.0))
    near = np.round(exact / step) * step
    best = min(
        misses(near + step * np.array(moves), exact, sensitivity)
        for moves in itertools.product(range(-4, 5), repeat=4)
    )
    assert misses(round_together(exact, sensitivity), exact, sensitivity) <= 2 * best


def test_zeros_stay():
    exact = np.array([0.0, 1.1, 0.0, 0.7])
    found = round_together(exact, np.eye(4))
    assert found.tolist() == exact.astype(np.float32).tolist()


def test_errors_that_do_nothing_stay_small():
    """Two coefficients of which only the sum matters, one without effect, one with hardly any."""
    exact = np.array([0.81, -0.41, 0.7, 1.3])
    sensitivity = np.array([[1.0, 1.0, 0.0, 1e-200]])
    found = round_together(exact, sensitivity)
    np.testing.assert_allclose(found, exact, rtol=4e-7)
    assert misses(found, exact, sensitivity) < 3e-8
