"""Problems of sensors that are not read in every sample, and what they refuse."""

from dataclasses import replace

import numpy as np
import pytest
from support.periodic_problems import lifted_problem, relative_distance
from support.refusals import require_refusals

import lbt_synth as lbt
from lbt_synth.errors import DefinitenessError, DimensionError, ProblemError
from lbt_synth.linear import EstimationProblem
from lbt_synth.linear.riccati.filtering import kalman_riccati, least_gamma

WALK = {
    "A": [[[1.0]]],
    "B": [[[1.0, 0.0, 0.0]]],
    "C": [[[1.0], [1.0]]],
    "D": [[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]],
    "L": [[1.0]],
    "read": [[True, False], [True, True]],
}


def test_gains_of_what_is_not_read_do_nothing():
    problem = EstimationProblem(**WALK)
    assert problem.restricted(np.array([False, True])).read.tolist() == [[False] * 2, [False, True]]
    gains = np.full((2, 1, 2), 0.3)
    error = problem.error_system(gains)
    np.testing.assert_allclose(error.A.ravel(), [0.7, 0.4])
    np.testing.assert_allclose(error.B[0], [[1.0, -0.3, 0.0]])
    same = problem.error_system(gains[0])  # one gain for all phases
    np.testing.assert_array_equal(same.A, error.A)


def test_a_problem_of_one_phase_in_which_all_is_read():
    one = EstimationProblem(A=0.9, B=[[1.0, 0.0]], C=1.0, D=[[0.0, 1.0]], L=1.0)
    stack = EstimationProblem(A=[[[0.9]]], B=[[[1.0, 0.0]]], C=[[[1.0]]], D=[[[0.0, 1.0]]], L=1.0)
    assert (one.period, one.read.tolist()) == (1, [[True]])
    assert all(getattr(stack, name).ndim == 2 for name in "ABCD")
    assert one.error_system(np.array([[[0.4]]])).A.tolist() == [[0.5]]


@pytest.mark.parametrize("read", [WALK["read"], None])
@pytest.mark.parametrize("factor", [1e-12, 1e9])
def test_the_unit_of_a_measurement_does_not_matter(factor, read):
    """SI units of one sensor beside nanometres of another."""
    one, units = EstimationProblem(**(WALK | {"read": read})), np.array([[1.0], [factor]])
    other = replace(one, C=one.C * units, D=one.D * units)
    start, again = kalman_riccati(one), kalman_riccati(other)
    assert relative_distance(again.P, start.P) < 1e-12
    assert relative_distance(again.gain_predictor * units.T, start.gain_predictor) < 1e-12
    if read:
        assert relative_distance(kalman_riccati(lifted_problem(other)).P, start.P[0]) < 1e-12
    upper = lbt.hinf_norm(one.error_system(start.gain_predictor)).upper
    brackets = [least_gamma(p, lower=0.1, upper=upper) for p in (one, other)]
    assert brackets[1][1] == pytest.approx(brackets[0][1], rel=1e-10)


def test_problems_that_are_none():
    sizes = {"A": (3, 3), "B": (3, 4), "C": (1, 3), "D": (1, 4), "L": (1, 3)}
    good = {name: np.ones(size) for name, size in sizes.items()} | {"A": np.eye(3) / 2}
    alike, problem = [[[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]], EstimationProblem(**WALK)

    def walk(**changes):
        return lambda: EstimationProblem(**(WALK | changes))

    def clash(name, size):
        return lambda: EstimationProblem(**(good | {name: np.ones(size)}))

    wrong = {"A": (3, 2), "B": (2, 4), "C": (1, 2), "D": (1, 3), "L": (1, 5)}
    rows = [(clash(*pair), DimensionError, f"{pair[0]} must") for pair in wrong.items()]
    none, ahead = np.array([False, False]), "samples ahead needs a period of 1; got one of 2"
    three, gains = r"one for each of 2 phases; got \(3, 1, 2\)", np.ones((3, 1, 2))
    rows += [
        (walk(read=[[True]]), DimensionError, r"read must be \(1, 2\) truth values"),
        (walk(read=[[False, False]]), DimensionError, "some of them true"),
        (lambda: problem.restricted(none), DimensionError, "some of them true"),
        (lambda: problem.error_system(gains), DimensionError, three),
        (walk(L=[[1.0, 1.0]]), DimensionError, "L must have 1 column to match A"),
        (walk(L=np.ones((0, 1))), DimensionError, "L with 0"),
        (walk(C=np.ones((0, 1)), D=np.ones((0, 3))), DimensionError, "C with 0 rows"),
        (walk(D=alike), DefinitenessError, "read at phase 1 is"),
        (walk(D=np.zeros((1, 2, 3))), DefinitenessError, "read at phase 0 is singular"),
        (walk(L=[[1e200]]), ProblemError, r"L must be within 1e\+75; got"),
        (walk(D=np.zeros((2, 3)), read=None), DefinitenessError, "Every measurement needs noise"),
        (lambda: problem.ahead(0), ProblemError, ahead),
        (lambda: problem.with_memory([[1.0, 1.0]]), ProblemError, "a filter with a memory needs"),
        (problem.with_unit_weights, ProblemError, "a scaling of disturbances needs"),
        (lambda: lbt.hinf(problem, route="lmi"), ProblemError, "needs a period of 1"),
    ]
    require_refusals(rows)
