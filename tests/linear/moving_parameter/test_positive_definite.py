"""Proofs of definiteness against exact rational arithmetic."""

from __future__ import annotations

import numpy as np
from support.rational import is_positive_definite

from lbt_synth.linear.moving_parameter.positive_definite import certainly_positive


def test_what_is_proved_holds_exactly():
    """Matrices whose least eigenvalue is of the size of rounding, on both sides of zero."""
    rng = np.random.default_rng(1)
    roots = rng.standard_normal((60, 6, 5))  # of rank 5
    least = rng.choice([-1, 1], 60) * 10.0 ** rng.uniform(-16, -11, 60)
    stack = roots @ np.swapaxes(roots, 1, 2) + least[:, None, None] * np.eye(6)
    stack = (stack + np.swapaxes(stack, 1, 2)) / 2
    proved = certainly_positive(stack, np.zeros(60))
    exact = np.array([is_positive_definite(each) for each in stack])
    assert np.all(exact[proved])
    assert 10 < proved.sum() < exact.sum() < 60


def test_a_matrix_that_only_rounding_makes_positive_is_refused():
    """Each entry is the closest number to 0.1 or its square; exactly, the determinant is not 0."""
    tenth = 0.1
    nearly = np.array([[[tenth * tenth, tenth], [tenth, 1.0]]])  # 0.1 * 0.1 was rounded
    assert np.linalg.eigvalsh(nearly[0])[0] > -1e-18
    assert not certainly_positive(nearly, np.zeros(1))[0]
    assert certainly_positive(nearly + 1e-13 * np.eye(2), np.zeros(1))[0]


def test_errors_count_and_nan_proves_nothing():
    stack = np.array([np.eye(3), np.eye(3), np.full((3, 3), np.nan), -np.eye(3)])
    errors = np.array([0.9, 1.1, 0.0, 0.0])
    assert certainly_positive(stack, errors).tolist() == [True, False, False, False]
