"""Problems of sensors that are not read in every sample."""

import numpy as np
import pytest
from support.periodic_problems import lifted_problem, random_periodic_problem, relative_distance

from lbt_synth.errors import DefinitenessError, DimensionError
from lbt_synth.linear import PeriodicProblem, kalman_riccati, periodic_kalman

WALK = {
    "A": [[[1.0]]],
    "B": [[[1.0, 0.0, 0.0]]],
    "C": [[[1.0], [1.0]]],
    "D": [[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]],
    "L": [[1.0]],
    "read": [[True, False], [True, True]],
}


def test_the_schedule_alone_may_have_a_period():
    problem = PeriodicProblem(**WALK)
    assert problem.period == 2
    assert problem.A.shape == (2, 1, 1)
    assert problem.n_measurements == 2
    assert [len(problem.parts(t)[2]) for t in range(2)] == [1, 2]


def test_a_measurement_that_is_left_out_is_not_read():
    problem = PeriodicProblem(**WALK).restricted(np.array([False, True]))
    assert problem.read.tolist() == [[False, False], [False, True]]
    with pytest.raises(DimensionError, match="some of them true"):
        problem.restricted(np.array([True, False]))


def test_gains_of_what_is_not_read_do_nothing():
    problem = PeriodicProblem(**WALK)
    gains = np.full((2, 1, 2), 0.3)
    error = problem.error_system(gains)
    np.testing.assert_allclose(error.A.ravel(), [0.7, 0.4])
    np.testing.assert_allclose(error.B[0], [[1.0, -0.3, 0.0]])


@pytest.mark.parametrize("factor", [1e-12, 1e9])
def test_the_unit_of_a_measurement_does_not_matter(factor):
    units = np.array([[1.0], [factor]])
    C, D = (np.asarray(WALK[name]) * units for name in "CD")
    own = periodic_kalman(PeriodicProblem(**WALK))
    other = PeriodicProblem(**(WALK | {"C": C, "D": D}))
    solved = periodic_kalman(other)
    assert relative_distance(solved.P, own.P) < 1e-12
    assert relative_distance(solved.gains * units[:, 0], own.gains) < 1e-12
    assert relative_distance(kalman_riccati(lifted_problem(other)).P, own.P[0]) < 1e-12


def test_the_problem_over_a_period_has_the_readings_of_a_period():
    problem = random_periodic_problem(3)
    lifted = lifted_problem(problem)
    assert len(lifted.C) == problem.read.sum()
    np.testing.assert_allclose(lifted.A, problem.monodromy)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"read": [[True]]}, DimensionError, r"read must be \(1, 2\) truth values"),
        ({"read": [[False, False]]}, DimensionError, "some of them true"),
        ({"L": [[1.0, 1.0]]}, DimensionError, r"L must have 1 columns; got \(1, 2\)"),
        (
            {"D": [[[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]]},
            DefinitenessError,
            "read at phase 1 is singular.*needs noise of its own",
        ),
        ({"D": np.zeros((1, 2, 3))}, DefinitenessError, "read at phase 0 is singular"),
    ],
)
def test_problems_that_are_none(changes, error, words):
    with pytest.raises(error, match=words):
        PeriodicProblem(**(WALK | changes))
