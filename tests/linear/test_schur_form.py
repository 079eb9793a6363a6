"""The Schur form, with and without LAPACK's complex iteration."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from lbt_synth.linear import schur_form


@pytest.mark.parametrize("fails", [False, True])
def test_the_form_gives_back_the_matrix(monkeypatch, fails):
    def stubborn(A, output):
        if output == "complex" and fails:
            raise scipy.linalg.LinAlgError("Schur form not found.")
        return scipy.linalg.schur(A, output=output)

    monkeypatch.setattr(schur_form, "schur", stubborn)
    rng = np.random.default_rng(0)
    shift = np.eye(6, k=-1)
    for A in (rng.standard_normal((7, 7)), shift, shift + np.eye(6, k=5)):
        T, U = schur_form.complex_schur(A)
        assert U @ T @ U.conj().T == pytest.approx(A, abs=1e-12)
        assert U @ U.conj().T == pytest.approx(np.eye(len(A)), abs=1e-12)
        assert not np.tril(T, -1).any()
