"""Modes that have no stabilising solution are named."""

import numpy as np
import pytest
import scipy.linalg

import lbt_synth as lbt


def test_undetectable_pairs_name_the_mode():
    with pytest.raises(
        lbt.errors.DetectabilityError, match=r"mode of A at 1.2.*no measurement sees it"
    ):
        lbt.kalman(
            lbt.EstimationProblem(
                A=np.diag([1.2, 0.5]), B=np.eye(2, 3), C=[[0, 1]], D=[[0, 0, 1]], L=[[1, 1]]
            )
        )
    with pytest.raises(lbt.errors.DetectabilityError, match=r"must be stabilisable.*at 2"):
        lbt.solve_dare(np.diag([2.0, 0.5]), [[0.0], [1.0]], np.eye(2), 1)


def test_an_undriven_mode_on_the_unit_circle_is_refused():
    with pytest.raises(lbt.errors.DetectabilityError, match="must be driven by noise") as caught:
        lbt.kalman(lbt.EstimationProblem(A=1.0, B=[[0.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0))
    assert caught.value.eigenvalue == pytest.approx(1)
    with pytest.raises(
        lbt.errors.DetectabilityError, match="Q must see every mode on the unit circle"
    ):
        lbt.solve_dare(1, 1, 0, 1)


def transmission_zeros(A, B, C):
    n, m = B.shape
    M = np.block([[A, B], [C, np.zeros((m, m))]])
    N = np.zeros_like(M)
    N[:n, :n] = np.eye(n)
    values = scipy.linalg.eigvals(M, N)
    return values[np.isfinite(values)]


def test_a_unit_circle_zero_of_a_singular_problem_is_named():
    """R = 0 and a plant with the zero z = 1: its cost does not see a slow drift of the input."""
    A = np.array([[0.5, 0.0], [1.0, 0.3]])
    B = np.array([[1.0], [0.0]])
    C = np.array([[1.0, -0.7]])  # C (z I - A)^-1 B = (z - 1) / ((z - 0.5) (z - 0.3))
    assert np.allclose(transmission_zeros(A, B, C), [1.0])
    with pytest.raises(
        lbt.errors.DetectabilityError, match="zero on the unit circle, at 1"
    ) as caught:
        lbt.solve_dare(A, B, C.T @ C, 0)
    assert caught.value.eigenvalue == pytest.approx(1)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("size", [1, 2, 3])
def test_undriven_blocks_on_the_unit_circle_are_named(seed, size):
    """Defective, and turned at random: their eigenvalues are found 1e-5 off the circle."""
    rng = np.random.default_rng(seed)
    n = size + 2
    A = np.zeros((n, n))
    A[:size, :size] = np.eye(size) + np.eye(size, k=1)
    A[size:, size:] = np.diag([0.5, 0.8])
    B = np.zeros((n, 2))
    B[size:] = rng.standard_normal((2, 2))
    turn = np.linalg.qr(rng.standard_normal((n, n)))[0]
    problem = lbt.EstimationProblem(
        A=turn @ A @ turn.T,
        B=np.hstack([turn @ B, np.zeros((n, 1))]),
        L=np.ones((1, n)),
        C=rng.standard_normal((1, n)),
        D=[[0.0, 0.0, 1.0]],
    )
    with pytest.raises(
        lbt.errors.DetectabilityError, match="must be driven by noise; the mode of A at"
    ) as caught:
        lbt.kalman(problem)
    assert abs(caught.value.eigenvalue - 1) < 1e-4
    if (
        size == 1
    ):  # a larger block is driven by the rounding of Q = B B', which is all solve_dare sees
        with pytest.raises(
            lbt.errors.DetectabilityError, match="Q must see every mode on the unit"
        ):
            lbt.solve_dare(problem.A.T, problem.C.T, problem.Q, problem.R)


def test_an_undriven_mode_that_decays_slowly_is_let_be():
    for gap in (1e-3, 1e-6, 1e-8):
        p = lbt.EstimationProblem(
            A=[[1 - gap, 0], [0, 0.5]], B=[[0, 0], [1, 0]], C=[[1, 1]], D=[[0, 1]], L=[[1, 1]]
        )
        assert np.max(np.abs(lbt.kalman(p).poles)) == pytest.approx(1 - gap, rel=1e-12)


@pytest.mark.parametrize("seed", range(60))
def test_no_solution_is_made_up_where_a_pole_is_on_the_circle(seed):
    """Unweighted modes at 1, single or double, in bases that hide them."""
    rng = np.random.default_rng(seed)
    T = rng.integers(-2, 3, (3, 3)).astype(float)
    if abs(np.linalg.det(T)) < 0.5:
        T = T + 3 * np.eye(3)
    inner = np.array([[1, 1, 0], [0, 1, 1], [0, 0, 0.5]]) if seed % 2 else np.diag([1, 0.3, 0.5])
    A, weighted = T @ inner @ np.linalg.inv(T), np.linalg.inv(T)[2]
    B = rng.integers(-2, 3, (3, 1)).astype(float)
    with pytest.raises((lbt.errors.DetectabilityError, lbt.errors.NumericalError)):
        lbt.solve_dare(A, B, np.outer(weighted, weighted), 1)
