"""Minima by scoring: without information, to an accuracy, and given up beyond a bound."""

from __future__ import annotations

import numpy as np
import pytest

from lbt_synth.identification.fit.scoring import Priors, scoring_minimum


def rosenbrock(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Half the squared residuals of Rosenbrock's valley, and of Gauss and Newton's matrix."""
    rest = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
    slope = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])
    return 0.5 * float(rest @ rest), slope.T @ rest, slope.T @ slope


def free(count: int) -> Priors:
    return Priors(centre=np.zeros(count), width=np.full(count, np.inf))


def test_a_curved_valley_is_followed_to_its_end() -> None:
    for start in ([-1.2, 1.0], [3.0, -20.0]):
        found = scoring_minimum(rosenbrock, np.array(start), free(2), accuracy=1e-12)
        assert found is not None
        assert found[0] == pytest.approx([1, 1], abs=1e-4)


def test_a_fit_that_cannot_reach_a_bound_is_given_up() -> None:
    def above(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value, slope, matrix = rosenbrock(x)
        return value + 7.0, slope, matrix

    start = np.array([-1.2, 1.0])
    assert scoring_minimum(above, start, free(2), bound=6.9) is None
    assert scoring_minimum(above, start, free(2), bound=9.0) is not None


def test_parameters_without_information_leave_the_steps_finite() -> None:
    # a component of no power has denormal information, and a step along it overflows
    scale = np.array([2.0, 1e-311, 1e-300, 1e-16])
    priors = Priors(centre=np.zeros(4), width=np.full(4, np.inf))

    def bowl(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        value = 0.5 * float(scale @ (x - 1) ** 2) - 1e-9 * float(np.sum(x))
        return value, scale * (x - 1) - 1e-9, np.diag(scale)

    found = scoring_minimum(bowl, np.array([5.0, 4.0, 3.0, 2.0]), priors)
    assert found is not None
    assert np.all(np.isfinite(found[0]))
    assert found[0][0] == pytest.approx(1, abs=1e-3)


def test_a_minimum_beyond_a_bound_lies_on_it() -> None:
    """What else is free goes on: the valley's floor at x = 0.5 is y = 0.25."""
    priors = Priors(
        centre=np.zeros(2), width=np.full(2, np.inf), bounds=(-9.0, np.array([0.5, 9.0]))
    )
    found = scoring_minimum(rosenbrock, np.array([-1.2, 1.0]), priors, accuracy=1e-12)
    assert found is not None
    assert found[0] == pytest.approx([0.5, 0.25], abs=1e-6)
