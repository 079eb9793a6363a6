"""solve_dare against published examples, closed forms and other solvers."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import slycot
from hypothesis import given
from hypothesis import strategies as st
from plants import random_problem

import lbt_synth as lbt
from lbt_synth.riccati import gamma_riccati, kalman_riccati, least_gamma


def residual(A, B, Q, R, S, X):
    gain = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A + S.T)
    return A.T @ X @ A - X + Q - (A.T @ X @ B + S) @ gain


def test_golden_ratio():
    assert lbt.solve_dare(1, 1, 1, 1).X[0, 0] == pytest.approx((1 + np.sqrt(5)) / 2, rel=1e-15)


@given(a=st.floats(-3, 3), q=st.floats(1e-6, 1e6), r=st.floats(1e-6, 1e6))
def test_scalar_closed_form(a, q, r):
    # x^2 + (r - r a^2 - q) x - q r = 0, b = 1
    half = (r * a**2 + q - r) / 2
    root = np.hypot(half, np.sqrt(q * r))
    exact = half + root if half >= 0 else q * r / (root - half)
    assert lbt.solve_dare(a, 1, q, r).X[0, 0] == pytest.approx(exact, rel=1e-9)


def test_darex_1_1():
    """Benner, Laub and Mehrmann, example 1.1: Q, R = I-like, published solution."""
    A = np.array([[4.0, 3.0], [-4.5, -3.5]])
    B = np.array([[1.0], [-1.0]])
    Q = np.array([[9.0, 6.0], [6.0, 4.0]])
    exact = (1 + np.sqrt(5)) / 2 * Q
    assert np.allclose(lbt.solve_dare(A, B, Q, [[1.0]]).X, exact, rtol=1e-12)


def test_darex_2_1_with_a_tiny_weight():
    """Example 2.1: A = [4, 3; -9/2, -7/2], R = delta; X = (1 + sqrt(1 + 4 delta)) / 2 Q."""
    A = np.array([[4.0, 3.0], [-4.5, -3.5]])
    B = np.array([[1.0], [-1.0]])
    Q = np.array([[9.0, 6.0], [6.0, 4.0]])
    for delta in (1e2, 1.0, 1e-2, 1e-6):
        exact = (1 + np.sqrt(1 + 4 * delta)) / 2 * Q
        found = lbt.solve_dare(A, B, Q, [[delta]]).X
        assert np.linalg.norm(found - exact) / np.linalg.norm(exact) < 1e-9, delta


@given(seed=st.integers(0, 10_000), n=st.integers(1, 8), m=st.integers(1, 3))
def test_random_equations_against_scipy(seed, n, m):
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
    W = rng.standard_normal((n + m, n + m))
    W = W @ W.T + 1e-3 * np.eye(n + m)
    Q, S, R = W[:n, :n], W[:n, n:], W[n:, n:]
    solution = lbt.solve_dare(A, B, Q, R, S)
    expected = scipy.linalg.solve_discrete_are(A, B, Q, R, s=S)
    assert np.allclose(solution.X, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert np.max(np.abs(solution.poles)) < 1
    scale = np.linalg.norm(solution.X, 1) * (1 + np.linalg.norm(A, 1) ** 2)
    assert np.linalg.norm(residual(A, B, Q, R, S, solution.X), 1) / scale < 1e-10


@given(seed=st.integers(0, 10_000))
def test_similarity_and_scaling(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((4, 4)), rng.standard_normal((4, 2))
    Q, R = np.eye(4), np.eye(2)
    X = lbt.solve_dare(A, B, Q, R).X
    T = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    turned = lbt.solve_dare(T.T @ A @ T, T.T @ B, T.T @ Q @ T, R).X
    assert np.allclose(T @ turned @ T.T, X, rtol=1e-8, atol=1e-8 * np.abs(X).max())
    assert np.allclose(lbt.solve_dare(A, B, 1e6 * Q, 1e6 * R).X, 1e6 * X, rtol=1e-8)


def test_an_ordinary_plant_that_scipy_refuses():
    """AR2 turbulence and a lightly damped vibration."""
    turbulence = lbt.ARModel(
        coefficients=[1.997477, -0.997555], driving_rms_nm=0.37, frame_rate_hz=800
    )
    line = lbt.Vibration(frequency_hz=20, damping=1e-4, rms_nm=800, direction=(1,))
    refused = 0
    for noise in np.geomspace(1e-2, 1e3, 12):
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=800, turbulence=turbulence, vibrations=[line], noise_nm=noise, modes=1
        )
        solution = kalman_riccati(plant)
        assert solution.residual < 1e-12
        try:
            scipy.linalg.solve_discrete_are(plant.A.T, plant.C.T, plant.Q, plant.R)
        except (np.linalg.LinAlgError, ValueError):
            refused += 1
    assert refused > 0


def test_kalman_riccati_against_slycot(axis_plant):
    p = axis_plant
    X = slycot.sb02od(4, 1, p.A.T, p.C.T, p.Q, p.R, "D")[0]
    assert np.allclose(kalman_riccati(p).P, X, rtol=1e-6, atol=1e-6 * np.abs(X).max())


def test_undetectable_pairs_name_the_mode():
    with pytest.raises(lbt.DetectabilityError, match=r"mode of A at 1.2.*no measurement sees it"):
        lbt.kalman(
            lbt.EstimationProblem(
                A=np.diag([1.2, 0.5]), B=np.eye(2, 3), C=[[0, 1]], D=[[0, 0, 1]], L=[[1, 1]]
            )
        )
    with pytest.raises(lbt.DetectabilityError, match=r"must be stabilisable.*at 2"):
        lbt.solve_dare(np.diag([2.0, 0.5]), [[0.0], [1.0]], np.eye(2), 1)


def test_an_undriven_mode_on_the_unit_circle_is_refused():
    with pytest.raises(lbt.DetectabilityError, match="must be driven by noise") as caught:
        lbt.kalman(lbt.EstimationProblem(A=1.0, B=[[0.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0))
    assert caught.value.eigenvalue == pytest.approx(1)
    with pytest.raises(lbt.DetectabilityError, match="Q must see every mode on the unit circle"):
        lbt.solve_dare(1, 1, 0, 1)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((np.eye(2), np.ones((3, 1)), np.eye(2), 1), r"B must have 2 rows to match A \(2, 2\)"),
        ((np.eye(2), np.ones((2, 1)), np.eye(3), 1), "Q must have 2 rows"),
        ((np.eye(2), np.ones((2, 1)), np.eye(2), np.eye(2)), "R must have 1 row "),
        ((np.eye(2), np.ones((2, 1)), [[1, 1], [0, 1]], 1), "Q must be symmetric"),
        ((np.eye(2), np.ones((2, 1)), [[1, 0], [0, -1]], 1), "Q must be positive semidefinite"),
        ((np.eye(2), np.ones((2, 1)), np.eye(2), 0), "R must be positive definite"),
        ((np.eye(2), np.ones((2, 1)), np.eye(2), np.nan), "R must be finite"),
        ((np.eye(2), np.ones((2, 1)), np.eye(2), 1, [[5], [5]]), "positive semidefinite"),
    ],
)
def test_wrong_equations_are_refused(arguments, text):
    with pytest.raises(lbt.ProblemError, match=text):
        lbt.solve_dare(*arguments)


def test_gamma_riccati_tends_to_the_kalman_filter(axis_plant):
    kalman = kalman_riccati(axis_plant)
    near = gamma_riccati(axis_plant, 1e9)
    assert np.allclose(near.gain_predictor, kalman.gain_predictor, rtol=1e-9)
    assert np.allclose(near.P, kalman.P, rtol=1e-9)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), q=st.integers(1, 2), l=st.integers(1, 2))
def test_gamma_filters_keep_their_bound(seed, n, q, l):
    """At any feasible level the recomputed norm stays below it, noise correlated or not."""
    problem = random_problem(np.random.default_rng(seed), n, q, l=l)
    kalman = kalman_riccati(problem)
    upper = lbt.hinf_norm(problem.error_system(kalman.gain_predictor)).upper
    lower = np.sqrt(np.linalg.eigvalsh(problem.L @ kalman.P @ problem.L.T)[-1])
    low, high, best = least_gamma(problem, lower=lower, upper=upper)
    assert low <= high <= upper * (1 + 1e-9)
    assert float(lbt.hinf_norm(problem.error_system(best.gain_predictor))) <= high * (1 + 1e-7)
    assert gamma_riccati(problem, low * (1 - 1e-6)) is None
    solution = gamma_riccati(problem, 1.1 * high)
    achieved = lbt.hinf_norm(problem.error_system(solution.gain_predictor))
    assert achieved.upper < 1.1 * high
