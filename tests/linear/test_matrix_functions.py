"""Roots of semidefinite matrices, stability, the Schur form, and parts of a graph."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from lbt_synth.linear import matrix_functions
from lbt_synth.linear.matrix_functions import component_labels, semidefinite_root


def test_root_of_a_matrix_of_rank_one():
    """Rounding makes some eigenvalues negative; the root has none of them."""
    v = np.random.default_rng(0).normal(size=(5, 1))
    root = semidefinite_root(v @ v.T)
    assert root @ root.T == pytest.approx(v @ v.T)
    assert np.isfinite(root).all()


@pytest.mark.parametrize("fails", [False, True])
def test_the_schur_form_gives_back_the_matrix(monkeypatch, fails):
    def stubborn(A, output):
        if output == "complex" and fails:
            raise scipy.linalg.LinAlgError("Schur form not found.")
        return scipy.linalg.schur(A, output=output)

    monkeypatch.setattr(matrix_functions, "schur", stubborn)
    shift, A = np.eye(6, k=-1), np.random.default_rng(0).standard_normal((7, 7))
    for matrix in (A, shift, shift + np.eye(6, k=5)):
        T, U = matrix_functions.complex_schur(matrix)
        assert U @ T @ U.conj().T == pytest.approx(matrix, abs=1e-12)
        assert U @ U.conj().T == pytest.approx(np.eye(len(matrix)), abs=1e-12)
        assert not np.tril(T, -1).any()


@given(seed=st.integers(0, 10_000), n=st.integers(1, 12), density=st.floats(0, 0.4))
def test_parts_are_those_of_scipy(seed, n, density):
    """Elements have the same number where scipy finds them in the same component."""
    links = np.random.default_rng(seed).random((n, n)) < density
    for strong, connection in ((False, "weak"), (True, "strong")):
        label = component_labels(links, strong=strong)
        _, expected = connected_components(links, connection=connection)
        assert np.array_equal(label[:, None] == label, expected[:, None] == expected)
        firsts = [np.flatnonzero(label == i)[0] for i in range(np.max(label) + 1)]
        assert firsts == sorted(firsts)
