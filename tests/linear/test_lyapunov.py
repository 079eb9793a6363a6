"""Lyapunov equations of a stack, against SciPy's."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from lbt_synth.linear.lyapunov import stationary_covariances


def test_stacked_lyapunov_is_scipys():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((20, 4, 4))
    A *= (rng.uniform(0.1, 0.9999, 20) / np.abs(np.linalg.eigvals(A)).max(axis=1))[:, None, None]
    B = rng.standard_normal((20, 4, 2))
    Q = B @ np.swapaxes(B, 1, 2)
    X, residuals = stationary_covariances(A, Q)
    assert np.all(residuals < 1e-13)
    for a, q, x in zip(A, Q, X, strict=True):
        assert np.allclose(x, solve_discrete_lyapunov(a, q), rtol=1e-7)
    unstable, _ = stationary_covariances(1.01 * np.eye(2)[None], np.eye(2)[None])
    assert not np.isfinite(unstable).any()
