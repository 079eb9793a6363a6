"""Roots of semidefinite matrices, and stability."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.linear.matrix_functions import is_stable, semidefinite_root


def test_root_of_a_matrix_of_rank_one():
    """Rounding makes some eigenvalues negative; the root has none of them."""
    v = np.random.default_rng(0).normal(size=(5, 1))
    root = semidefinite_root(v @ v.T)
    assert root @ root.T == pytest.approx(v @ v.T)
    assert np.isfinite(root).all()


@pytest.mark.parametrize(("radius", "stable"), [(0.999, True), (1.0, False), (1.001, False)])
def test_rotation_is_stable_inside_the_circle(radius, stable):
    turn = np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    assert is_stable(radius * turn) is stable
