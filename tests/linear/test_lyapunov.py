"""Lyapunov equations of a stack, against SciPy's."""

import mpmath
import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

import lbt_synth as lbt
from lbt_synth.linear.lyapunov import stationary_covariance, stationary_covariances, stationary_root


def test_stacked_lyapunov_is_scipys():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((20, 4, 4))
    A *= (rng.uniform(0.1, 0.9999, 20) / np.abs(np.linalg.eigvals(A)).max(axis=1))[:, None, None]
    B = rng.standard_normal((20, 4, 2))
    X, residuals = stationary_covariances(A, B @ np.swapaxes(B, 1, 2))
    assert np.all(residuals < 1e-13)
    for a, b, x in zip(A, B, X, strict=True):
        root = stationary_root(a, b)
        expected = solve_discrete_lyapunov(a, b @ b.T)
        assert np.allclose([x, root @ root.T], expected, rtol=1e-7)
    unstable, _ = stationary_covariances(1.01 * np.eye(2)[None], np.eye(2)[None])
    assert not np.isfinite(unstable).any()


def test_a_root_keeps_variances_that_a_covariance_loses():
    """Two states that move alike but for 1e-9 of a noise of their own."""
    A, B = np.diag([0.9, 0.9]), np.array([[1.0, 0.0], [1.0, 1e-9]])
    difference = np.array([1.0, -1.0]) @ stationary_root(A, B)
    assert np.sum(difference**2) == pytest.approx(1e-18 / (1 - 0.81), rel=1e-6)


TURN = 2 * np.pi * 0.5 / 4000  # of a slow line, per frame


@pytest.mark.parametrize(
    ("poles", "limit"),
    [
        (1 - np.array([1e-4, 1e-3, 1e-2, 1e-1]), 1e-5),
        (1 - np.array([1e-5, 1e-4, 1e-3]), 1e-3),
        (np.exp(-TURN * np.array([1e-3 + 1j, 1e-3 - 1j])), 1e-7),
        (np.exp(-TURN * np.array([1e-5 + 1j, 1e-5 - 1j])), 1e-4),
    ],
)
def test_slow_poles_against_90_digits(poles, limit):
    """Squaring the triangular form leaves a residual of 1e-14 and is off by factors."""
    n = len(poles)
    A, Q = np.eye(n, k=-1), np.diag(np.eye(n)[0])
    A[0] = -np.poly(poles).real[1:]
    with mpmath.workdps(90):
        power, exact = mpmath.matrix(A.tolist()), mpmath.matrix(Q.tolist())
        for _ in range(45):
            exact, power = exact + power * exact * power.T, power * power
        exact = np.array(exact.tolist(), dtype=float)
    X, residuals = stationary_covariances(A[None], Q[None])
    assert X[0] == pytest.approx(exact, rel=limit)
    assert stationary_covariance(A, Q) == pytest.approx(exact, rel=limit)
    assert residuals[0] < 1e-14


def test_an_unstable_system_has_no_stationary_covariance():
    for pole in (1.0, -1.5):
        words = f"a pole of modulus {abs(pole):g}"
        with pytest.raises(lbt.errors.UnstableLoopError, match=words):
            stationary_covariance(np.diag([0.5, pole]), np.eye(2))
