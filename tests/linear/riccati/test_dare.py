"""solve_dare against published examples, closed forms and other solvers."""

import contextlib
from functools import partial

import numpy as np
import pytest
import scipy.linalg
import slycot
from hypothesis import given, settings
from hypothesis import strategies as st
from support.periodic_problems import relative_distance
from support.plants import lbt_axis_plant
from support.refusals import refused, require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DetectabilityError, NumericalError, ProblemError
from lbt_synth.linear import GeneralizedPlant
from lbt_synth.linear.riccati import dare


@given(a=st.floats(-3, 3), q=st.floats(1e-6, 1e6), r=st.floats(1e-6, 1e6))
def test_scalar_closed_form(a, q, r):
    # x^2 + (r - r a^2 - q) x - q r = 0, b = 1
    half = (r * a**2 + q - r) / 2
    root = np.hypot(half, np.sqrt(q * r))
    exact = half + root if half >= 0 else q * r / (root - half)
    assert lbt.solve_dare(a, 1, q, r).X[0, 0] == pytest.approx(exact, rel=1e-9)


def random_stack(seed, count, n, m):
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((count, n + m, n + m))
    W = W @ np.swapaxes(W, -1, -2) + 1e-3 * np.eye(n + m)
    A, B = rng.standard_normal((count, n, n)), rng.standard_normal((count, n, m))
    return A, B, W[:, :n, :n], W[:, n:, n:], W[:, :n, n:]


@given(seed=st.integers(0, 10_000), n=st.integers(1, 8), m=st.integers(1, 3))
def test_random_equations_against_scipy(seed, n, m):
    A, B, Q, R, S = (matrices[0] for matrices in random_stack(seed, 1, n, m))
    solution = lbt.solve_dare(A, B, Q, R, S)
    X, expected = solution.X, scipy.linalg.solve_discrete_are(A, B, Q, R, s=S)
    assert np.allclose(X, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert np.max(np.abs(solution.poles)) < 1
    gain = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A + S.T)
    residual = A.T @ X @ A - X + Q - (A.T @ X @ B + S) @ gain
    scale = np.linalg.norm(X, 1) * (1 + np.linalg.norm(A, 1) ** 2)
    assert np.linalg.norm(residual, 1) / scale < 1e-10


EYE, TWO = np.eye(2), np.ones((2, 1))


WRONG = [
    (EYE, np.ones((3, 1)), EYE, 1, r"B must have 2 rows to match A \(2, 2\)"),
    (EYE, TWO, np.eye(3), 1, "Q must have 2 rows"),
    (EYE, TWO, EYE, EYE, "R must have 1 row "),
    (EYE, TWO, [[1, 1], [0, 1]], 1, "Q must be symmetric"),
    (EYE, np.zeros((2, 0)), EYE, np.zeros((0, 0)), "at least one column"),
    (0.5 * EYE, np.ones((2, 2)), EYE, np.zeros((2, 2)), "R must be positive def"),
    (EYE, TWO, EYE, np.nan, "R must be finite"),
    (EYE[None], TWO, EYE, 1, np.ones((3, 1)), "S must have 2 rows"),
    (np.ones((2, 1, 1)), 1, np.ones((3, 1, 1)), 1, "leading dimensions.*A .2, 1, 1."),
    (1, 1, [1], 1, "Q must be a matrix .2-D. or a stack"),
]


def test_equations_without_a_solution_are_refused():
    solve, hidden = lbt.solve_dare, DetectabilityError
    A, B = np.array([[[0.5]], [[2.0]], [[0.5]]]), np.array([[[1.0]], [[0.0]], [[1.0]]])
    undriven = lbt.EstimationProblem(A=1.0, B=[[0.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    mode = np.array([[5.0, 4.0, 3.0, 2.0, 1.0]]).T  # no measurement shows it
    growing, seen = 0.5 * np.eye(5) + 1.5 * mode @ mode.T / 55, [[1.0, -1.0, -1.0, 1.0, 0.0]]
    plant = GeneralizedPlant(A=growing, B1=mode, B2=mode, C1=mode.T, C2=seen)
    rows = [
        (lambda: solve(A, B, 1, 1), hidden, r"equation 1: \(A, B\) must be stabilis.* at 2"),
        (lambda: solve(A[None], B[None], 1, 1), hidden, r"equation \(0, 1\)"),
        (lambda: lbt.kalman(undriven), hidden, r"driven by noise; the mode of A at 1 "),
        (lambda: solve(1, 1, 0, 1), hidden, "Q must see every mode on the unit circle"),
        (lambda: solve(2, 1, 1, 1, 1), hidden, "Q must see every mode"),  # 1 without its S is 0
        (lambda: lbt.h2_controller(plant), hidden, r"0 \(1\), 1 \(0.8\), .* 3 \(0.4\), \.\.\."),
        (lambda: solve(0.5, 1, 0, 0), NumericalError, "gave no stable closed loop"),
    ]
    rows += [(partial(solve, *parts), ProblemError, words) for *parts, words in WRONG]
    require_refusals(rows)


def test_leading_dimensions_are_broadcast():
    A, B, Q, R, _ = random_stack(1, 4, 3, 1)
    many, empty = lbt.solve_dare(A[0], B[0], Q, R[0]), lbt.solve_dare(A[:0], B[0], Q[0], R[0])
    assert (many.X.shape, empty.X.shape) == ((4, 3, 3), (0, 3, 3))
    assert np.allclose(many.X[2], lbt.solve_dare(A[0], B[0], Q[2], R[0]).X, rtol=1e-12)
    assert empty.residual == empty.error == 0


@settings(max_examples=5)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), m=st.integers(1, 3))
def test_a_stack_is_its_equations_one_by_one(seed, n, m):
    parts = random_stack(seed, 6, n, m)
    stack = lbt.solve_dare(*(part.reshape(2, 3, *part.shape[1:]) for part in parts))
    sizes = {"X": (n, n), "gain_feedback": (m, n), "poles": (n,), "residuals": (), "errors": ()}
    for name, size in sizes.items():
        assert getattr(stack, name).shape == (2, 3, *size)
        assert not getattr(stack, name).flags.writeable
    for i in range(6):
        one, where = lbt.solve_dare(*(part[i] for part in parts)), np.unravel_index(i, (2, 3))
        assert np.allclose(stack.X[where], one.X, rtol=1e-13, atol=1e-13 * np.abs(one.X).max())
        assert one.X.shape == (n, n)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4))
def test_indefinite_weights_against_slycot(seed, n):
    """State feedback H-infinity: R = diag(-gamma^2, 1); the level is generous."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= 0.9 / max(abs(np.linalg.eigvals(A)))
    B = rng.standard_normal((n, 2))
    open_loop = float(lbt.hinf_norm((A, B[:, :1], np.eye(n), np.zeros((n, 1)))))
    R = np.diag([-((1.5 * open_loop) ** 2), 1.0])
    solution = lbt.solve_dare(A, B, np.eye(n), R)
    with np.errstate(all="ignore"):
        expected = slycot.sb02od(n, 2, A, B, np.eye(n), R, "D")[0]
    assert np.allclose(solution.X, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    assert np.linalg.eigvalsh(solution.X)[0] > 0


def test_badly_scaled_states_are_balanced():
    """States in units of 1e-6 to 1e6 times their own: the same solution, to rounding."""
    rng, plant = np.random.default_rng(4), lbt_axis_plant(damping=1e-4)
    exact = lbt.solve_dare(plant.A.T, plant.C.T, plant.Q, plant.R).X
    for units in 10.0 ** rng.uniform(-6, 6, (5, 4)):
        A, C, both = plant.A * units[:, None] / units, plant.C / units, np.outer(units, units)
        solution = lbt.solve_dare(A.T, C.T, plant.Q * both, plant.R)
        assert solution.route == "doubling"
        limit = 1e-9 * np.abs(exact).max()
        assert np.allclose(solution.X / both, exact, rtol=1e-9, atol=limit)


def test_the_schur_form_takes_over_where_doubling_fails(monkeypatch):
    solve = partial(lbt.solve_dare, 1, 1, 1 / 16, 1.25)
    for X in (np.nan, -0.25):  # 16 x^2 = x + 5 / 4; the pole of this root is 1.25
        monkeypatch.setattr(dare, "solve_by_doubling", lambda e, X=X: (np.full_like(e.Q, X), 1))
        solution = solve()
        assert solution.X[0, 0] == pytest.approx(0.3125, rel=1e-14)
        assert solution.route == "schur"
    monkeypatch.setattr(dare, "solve_by_schur", lambda equations: np.full_like(equations.Q, X))
    refused(solve, NumericalError, "gave no stable closed loop")
    monkeypatch.undo()
    monkeypatch.setattr(dare, "RESIDUAL_LIMIT", -1.0)
    refused(solve, NumericalError, r"and a pole 0\.2 inside the unit circle")


def test_sizes_from_1e_minus_300_to_1e300():
    """Weights of any size give X of that size; nothing under- or overflows on the way."""
    A, B = np.array([[1.2, 1.0], [0.0, 0.5]]), [[0.0], [1.0]]
    expected = lbt.solve_dare(A, B, EYE, 1.0)
    assert expected.X[0, 0] == pytest.approx(4.517, abs=1e-3)
    for size in (1e-300, 1e-162, 1e-150, 1e150, 1e155, 1e300):
        solution = lbt.solve_dare(A, B, size * EYE, size)
        assert np.allclose(solution.X / size, expected.X, rtol=1e-12)
        assert 0 < solution.residual < 1e-14
    for numbers in ((1e200, 1, 1, 1), ([[0, 1e160], [0, 0]], B, EYE, 1)):
        with pytest.raises(NumericalError, match="was not solved"):
            lbt.solve_dare(*numbers)


@pytest.mark.parametrize("weight", [1e-8, 1e-20])
def test_a_pole_next_to_the_circle_is_accurate(weight):
    """x^2 = weight (x + 1): the pole is 1 / (1 + x), the closer the smaller the weight."""
    exact = (weight + np.sqrt(weight**2 + 4 * weight)) / 2
    solution = lbt.solve_dare(1, 1, weight, 1)
    assert solution.X[0, 0] == pytest.approx(exact, rel=1e-14)
    assert 1 - abs(solution.poles[0]) == pytest.approx(exact / (1 + exact), rel=1e-5)


def test_the_estimated_error_is_of_the_size_of_the_error():
    """A nearly singular problem: 2.5 of DAREX with tau = 1e8, and an easy one."""
    *problem, X = EXAMPLES["2.5 tau=1e+08"]
    solution = lbt.solve_dare(*problem)
    assert 1e-15 < solution.error < 1e-10
    assert relative_distance(solution.X, X) < 100 * solution.error
    assert lbt.solve_dare(1, 1, 1, 1).error < 1e-15


# Examples of DAREX that have a known solution: P. Benner, A. J. Laub, V. Mehrmann, "A collection of
# benchmark examples for the numerical solution of algebraic Riccati equations II: discrete-time
# case", report SPC 95_23, TU Chemnitz-Zwickau (1995); numbers of version 2.0 (J. Abels, P. Benner,
# SLICOT working note 1999-16), as in SLICOT's BB02AD.


def example_2_1(delta):
    Q = np.array([[9.0, 6.0], [6.0, 4.0]])
    return [[4, 3], [-4.5, -3.5]], [[1], [-1]], Q, delta, (1 + np.sqrt(1 + 4 * delta)) / 2 * Q


def example_2_3(epsilon):
    return [[0, epsilon], [0, 0]], [[0], [1]], EYE, 1, np.diag([1, 1 + epsilon**2])


def example_2_4(epsilon):
    V, one = np.eye(3) - 2 / 3, epsilon * np.eye(3)
    A = np.array([[16.0, 10, -2], [10, 13, -8], [-2, -8, 7]]) / 9  # V diag(0, 1, 3) V
    roots = [1, (1 + np.sqrt(5)) / 2, (9 + np.sqrt(85)) / 2]
    return A, np.eye(3), one, one, epsilon * V @ np.diag(roots) @ V


def example_2_5(tau):
    alpha, beta, r = 1 - 1 / tau, 1 / tau, 0.25
    A = np.eye(4, k=-1)
    A[0, 0] = alpha
    t = r * (alpha + 1) * (alpha - 1) + beta**2
    x = (t + np.sqrt(t * t + 4 * beta**2 * r)) / 2 / beta**2
    return A, beta * np.eye(4, 1), np.diag([0, 0, 0, 1]), r, np.diag([x, 1, 1, 1])


def example_1_4(a, x):
    """It is printed with a = 0.01 and x = 0, which do not fit each other: x is -9.9, or a 0.1."""
    A, B = [[0, 0.1, 0], [0, 0, a], [0, 0, 0]], [[1, 0], [0, 0], [0, 1]]
    return A, B, np.diag([1e5, 1e3, -10]), np.diag([0, 1]), np.diag([1e5, 1e3, x])


SQUARE, CHAIN = [[1, 2], [2, 4]], np.eye(100)
EXAMPLES = {
    "1.1": ([[2, -1], [1, 0]], [[1], [0]], np.diag([0, 1]), 0, EYE),
    "1.3": ([[0, 1], [0, 0]], [[0], [1]], SQUARE, 1, [[1, 2], [2, 2 + np.sqrt(5)]]),
    "1.4 A=0.01": example_1_4(0.01, -9.9),
    "1.4 A=0.1": example_1_4(0.1, 0),
    "4.1 n=100": (np.eye(100, k=1), CHAIN[:, -1:], CHAIN, 1, np.diag(np.arange(1, 101))),
    **{f"2.1 delta={delta:g}": example_2_1(delta) for delta in (1e6, 1e-6, 1.0, 1e10)},
    **{f"2.3 epsilon={epsilon:g}": example_2_3(epsilon) for epsilon in (1e6, 1e3, 1.0)},
    **{f"2.4 epsilon={epsilon:g}": example_2_4(epsilon) for epsilon in (1e6, 1.0, 1e-6)},
    **{f"2.5 tau={tau:g}": example_2_5(tau) for tau in (1e8, 1e6, 1e4)},
}


def peers(A, B, Q, R):
    """Answers of scipy and SLICOT, those that they give."""
    A, B, Q, R = (np.atleast_2d(part).astype(float) for part in (A, B, Q, R))
    failures = np.linalg.LinAlgError, ValueError, ArithmeticError
    with np.errstate(all="ignore"), contextlib.suppress(*failures):
        yield scipy.linalg.solve_discrete_are(A, B, Q, R)
    with np.errstate(all="ignore"), contextlib.suppress(*failures):
        yield slycot.sb02od(*B.shape, A, B, Q, R, "D")[0]


@pytest.mark.parametrize("name", EXAMPLES)
def test_known_solutions(name):
    """Never worse than ten times the better of the peers, nor than rounding."""
    *problem, exact = EXAMPLES[name]
    solution = lbt.solve_dare(*problem)
    error = relative_distance(solution.X, exact)
    least = min(relative_distance(X, exact) for X in peers(*problem))
    assert error <= 10 * max(least, np.finfo(float).eps)
    assert error < 1e-12
    assert np.max(np.abs(solution.poles)) < 1


@pytest.mark.parametrize(("seed", "size"), [(0, 1), (1, 2), (2, 3)])
def test_undriven_blocks_on_the_unit_circle_are_named(seed, size):
    """Defective, and turned at random: their eigenvalues are found 1e-5 off the circle."""
    rng, n = np.random.default_rng(seed), size + 2
    A = scipy.linalg.block_diag(np.eye(size) + np.eye(size, k=1), np.diag([0.5, 0.8]))
    B = np.zeros((n, 3))
    B[size:, :2] = rng.standard_normal((2, 2))
    turn = np.linalg.qr(rng.standard_normal((n, n)))[0]
    parts = {"A": turn @ A @ turn.T, "B": turn @ B, "L": np.ones((1, n)), "D": [[0.0, 0.0, 1.0]]}
    problem = lbt.EstimationProblem(**parts, C=rng.standard_normal((1, n)))
    words = "must be driven by noise; the mode of A at"
    error = refused(lambda: lbt.kalman(problem), DetectabilityError, words)
    assert abs(error.eigenvalue - 1) < 1e-4


@pytest.mark.parametrize("seed", range(10))
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
