"""Semidefinite programmes as arrays, against programmes with known answers."""

import numpy as np
import pytest
from scipy import sparse

from lbt_synth.linear.lmi.conic_data import ConicProgramme, SymmetricUnknown, dual_matrix


def random_symmetric(rng, n):
    M = rng.standard_normal((n, n))
    return M + M.T


def test_rows_of_a_congruence():
    rng = np.random.default_rng(0)
    for n, d in ((1, 1), (3, 2), (4, 6)):
        unknown, P = SymmetricUnknown(np.zeros(n, dtype=int)), random_symmetric(rng, n)
        x = P[np.triu_indices(n)]
        M = rng.standard_normal((d, n))
        np.testing.assert_allclose(unknown.congruence(M) @ x, M @ P @ M.T, atol=1e-12)
        np.testing.assert_array_equal(unknown.matrix(x), P)
        assert unknown.trace @ x == pytest.approx(np.trace(P))


def test_largest_eigenvalue_and_its_vector():
    """The least t with ``t I - H >= 0`` is the largest eigenvalue; its multiplier is ``v v'``."""
    H = random_symmetric(np.random.default_rng(1), 4)
    programme = ConicProgramme(1)
    programme.add_semidefinite(sparse.csr_matrix(np.eye(4).reshape(-1, 1)), -H[None])
    found = programme.minimize(np.ones(1))
    values, vectors = np.linalg.eigh(H)
    assert found.status == "optimal"
    assert found.x[0] == pytest.approx(values[-1], rel=1e-6)
    v = vectors[:, -1]
    np.testing.assert_allclose(dual_matrix(found.dual), np.outer(v, v), atol=1e-5)


def test_greatest_matrix_below_another():
    """The P of greatest trace with ``H - M P M' >= 0`` and M invertible is ``M^-1 H M^-T``."""
    rng = np.random.default_rng(2)
    M, root = np.eye(3) + 0.3 * rng.standard_normal((3, 3)), rng.standard_normal((3, 3))
    H = root @ root.T
    unknown = SymmetricUnknown(np.zeros(3, dtype=int))
    programme = ConicProgramme(unknown.size)
    rows = -unknown.congruence(M).reshape(9, -1)
    programme.add_semidefinite(sparse.csr_matrix(rows), H[None])
    found = programme.minimize(-unknown.trace)
    inverse = np.linalg.inv(M)
    np.testing.assert_allclose(unknown.matrix(found.x), inverse @ H @ inverse.T, atol=1e-5)
