"""Lyapunov equations of a stack, against SciPy's."""

from fractions import Fraction

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
    Q = B @ np.swapaxes(B, 1, 2)
    X, residuals = stationary_covariances(A, Q)
    assert np.all(residuals < 1e-13)
    for a, q, x in zip(A, Q, X, strict=True):
        assert np.allclose(x, solve_discrete_lyapunov(a, q), rtol=1e-7)
    unstable, _ = stationary_covariances(1.01 * np.eye(2)[None], np.eye(2)[None])
    assert not np.isfinite(unstable).any()


@pytest.mark.parametrize(("damping", "limit"), [(1e-3, 1e-7), (1e-5, 1e-4)])
def test_a_slow_line_has_its_closed_form_variance(damping, limit):
    """Rounding of the residual in double precision moves it by 2e-6 and 4e-3."""
    line = lbt.Vibration(frequency_hz=0.5, damping=damping, rms_nm=1.0).ar_model(4000)
    drive = np.zeros((1, 2, 2))
    drive[0, 0, 0] = line.driving_rms_nm**2
    X, residuals = stationary_covariances(line.companion[None], drive)
    a1, a2 = map(Fraction, line.coefficients.tolist())  # their rounding moves it by 6e-3
    exact = Fraction(float(drive[0, 0, 0])) * (1 - a2) / ((1 + a2) * ((1 - a2) ** 2 - a1**2))
    assert X[0, 0, 0] == pytest.approx(float(exact), rel=limit)
    assert residuals[0] < 1e-14


@pytest.mark.parametrize("seed", range(2))
def test_a_root_is_that_of_the_covariance(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((6, 6)), rng.standard_normal((6, 2))
    A *= 0.97 / np.max(np.abs(np.linalg.eigvals(A)))
    root = stationary_root(A, B)
    np.testing.assert_allclose(root @ root.T, solve_discrete_lyapunov(A, B @ B.T), rtol=1e-9)


def test_a_root_keeps_variances_that_a_covariance_loses():
    """Two states that move alike but for 1e-9 of a noise of their own."""
    A, B = np.diag([0.9, 0.9]), np.array([[1.0, 0.0], [1.0, 1e-9]])
    difference = np.array([1.0, -1.0]) @ stationary_root(A, B)
    assert np.sum(difference**2) == pytest.approx(1e-18 / (1 - 0.81), rel=1e-6)


@pytest.mark.parametrize(
    ("gaps", "limit"), [((1e-4, 1e-3, 1e-2, 1e-1), 1e-5), ((1e-5, 1e-4, 1e-3), 1e-3)]
)
def test_several_slow_poles_against_90_digits(gaps, limit):
    """Squaring the triangular form leaves a residual of 1e-14 and is off by factors."""
    n = len(gaps)
    A, Q = np.eye(n, k=-1), np.diag(np.eye(n)[0])
    A[0] = -np.poly(1 - np.array(gaps))[1:]
    with mpmath.workdps(90):
        power, exact = mpmath.matrix(A.tolist()), mpmath.matrix(Q.tolist())
        for _ in range(45):
            exact, power = exact + power * exact * power.T, power * power
        exact = np.array(exact.tolist(), dtype=float)
    assert stationary_covariance(A, Q) == pytest.approx(exact, rel=limit)
    assert stationary_covariances(A[None], Q[None])[0][0] == pytest.approx(exact, rel=limit)


def test_an_unstable_system_has_no_stationary_covariance():
    for pole in (1.0, -1.5):
        words = f"a pole of modulus {abs(pole):g}"
        with pytest.raises(lbt.errors.UnstableLoopError, match=words):
            stationary_covariance(np.diag([0.5, pole]), np.eye(2))
